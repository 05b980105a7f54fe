// A node of rclcpp: a timer, a subscription and a publisher; with the argument "multi" four threads and reentrant
// callbacks, of which one sleeps; with "events" the EventsExecutor, whose timers have a thread.
#include <atomic>
#include <chrono>
#include <memory>
#include <string>
#include <thread>

#include "rclcpp/experimental/executors/events_executor/events_executor.hpp"
#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/string.hpp"

using std_msgs::msg::String;

class Counter : public rclcpp::Node {
public:
  explicit Counter(bool is_reentrant) : Node("counter") {
    using std::chrono_literals::operator""ms;
    const auto kind = is_reentrant ? rclcpp::CallbackGroupType::Reentrant : rclcpp::CallbackGroupType::MutuallyExclusive;
    group_ = create_callback_group(kind);
    rclcpp::SubscriptionOptions options;
    options.callback_group = group_;
    publisher_ = create_publisher<String>("/out", 10);
    const auto take = [this](const String & message) { ++count_; say("got " + message.data); };
    const auto take_slowly = [this](const String & message) {
      std::this_thread::sleep_for(30ms);
      say("later " + message.data);
    };
    subscription_ = create_subscription<String>("/in", 10, take, options);
    if (is_reentrant) slow_ = create_subscription<String>("/in", 10, take_slowly, options);
    timer_ = create_wall_timer(50ms, [this] { ++ticks_; say("tick"); }, group_);
  }

private:
  void say(const std::string & what) {
    String text;
    text.data = what + " count=" + std::to_string(count_) + " ticks=" + std::to_string(ticks_) + " at " +
      std::to_string(now().nanoseconds());
    publisher_->publish(text);
  }

  std::atomic<int> count_{0}, ticks_{0};
  rclcpp::CallbackGroup::SharedPtr group_;
  rclcpp::Publisher<String>::SharedPtr publisher_;
  rclcpp::Subscription<String>::SharedPtr subscription_, slow_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int count, char ** words) {
  rclcpp::init(count, words);
  const std::string kind = count > 1 ? words[1] : "";
  const auto node = std::make_shared<Counter>(kind == "multi");
  std::unique_ptr<rclcpp::Executor> executor;
  if (kind == "multi")
    executor = std::make_unique<rclcpp::executors::MultiThreadedExecutor>(rclcpp::ExecutorOptions(), 4);
  else if (kind == "events")
    executor = std::make_unique<rclcpp::experimental::executors::EventsExecutor>();
  else
    executor = std::make_unique<rclcpp::executors::SingleThreadedExecutor>();
  executor->add_node(node);
  executor->spin();
  rclcpp::shutdown();
}
