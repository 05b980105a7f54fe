// Two components for a component container: one sends poses, images and texts as unique pointers and as loaned messages;
// the other one receives them, and what the gateway publishes.  It reports what it received, and whether a message is the
// very one that was sent: by its address.
#include <array>
#include <atomic>
#include <chrono>
#include <memory>
#include <string>

#include "geometry_msgs/msg/pose_stamped.hpp"
#include "geometry_msgs/msg/transform_stamped.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_components/register_node_macro.hpp"
#include "sensor_msgs/msg/image.hpp"
#include "std_msgs/msg/string.hpp"

namespace judge {

using geometry_msgs::msg::PoseStamped;
using geometry_msgs::msg::TransformStamped;
using sensor_msgs::msg::Image;
using std_msgs::msg::String;

constexpr int MESSAGES = 20;
// The address of each image that was sent, by its number: both components are in one process.
static std::array<std::atomic<const void *>, MESSAGES + 1> sent_at{};

class Talker : public rclcpp::Node {
public:
  explicit Talker(const rclcpp::NodeOptions & options) : Node("talker", options) {
    using std::chrono_literals::operator""ms;
    poses_ = create_publisher<PoseStamped>("/igtl/out/Pose", 10);
    images_ = create_publisher<Image>("/igtl/out/Image", 10);
    texts_ = create_publisher<String>("/igtl/out/Text", 10);
    timer_ = create_wall_timer(50ms, [this] { turn(); });
  }

private:
  void turn() {
    // The bridge and the other component.
    if (count_ >= MESSAGES || poses_->get_subscription_count() < 2 || images_->get_subscription_count() < 2 ||
      texts_->get_subscription_count() < 2) return;
    ++count_;
    auto loan = poses_->borrow_loaned_message();
    loan.get().header.frame_id = "Base";
    loan.get().header.stamp.sec = count_;
    loan.get().pose.position.x = 0.001 * count_;
    loan.get().pose.orientation.w = 1.0;
    poses_->publish(std::move(loan));
    auto image = std::make_unique<Image>();
    image->header.stamp.sec = count_;
    image->header.frame_id = "Base";
    image->width = image->height = image->step = 64;
    image->encoding = "mono8";
    image->data.assign(64 * 64, static_cast<uint8_t>(count_));
    sent_at[count_] = image.get();
    images_->publish(std::move(image));
    auto text = std::make_unique<String>();
    text->data = "text " + std::to_string(count_);
    texts_->publish(std::move(text));
  }

  int count_ = 0;
  rclcpp::Publisher<PoseStamped>::SharedPtr poses_;
  rclcpp::Publisher<Image>::SharedPtr images_;
  rclcpp::Publisher<String>::SharedPtr texts_;
  rclcpp::TimerBase::SharedPtr timer_;
};

class Listener : public rclcpp::Node {
public:
  explicit Listener(const rclcpp::NodeOptions & options) : Node("listener", options) {
    report_ = create_publisher<String>("/judge/report", rclcpp::QoS(100).transient_local(), without_intra_process());
    images_ = create_subscription<Image>("/igtl/out/Image", 10, [this](Image::UniquePtr image) {
      say("image " + std::to_string(image->header.stamp.sec) + (image.get() == sent_at.at(image->header.stamp.sec) ? " same" : " copy"));
    });
    poses_ = create_subscription<PoseStamped>("/igtl/out/Pose", 10, [this](PoseStamped::ConstSharedPtr pose) {
      say("pose " + std::to_string(pose->header.stamp.sec));
    });
    texts_ = create_subscription<String>("/igtl/out/Text", 10, [this](String::UniquePtr text) { say(text->data); });
    in_ = create_subscription<TransformStamped>("/igtl/in/ToolToBase/transform", 10,
      [this](TransformStamped::UniquePtr pose) {
        say("in " + std::to_string(std::lround(pose->transform.translation.x * 1000)));
      });
  }

private:
  static rclcpp::PublisherOptions without_intra_process() {
    rclcpp::PublisherOptions options;
    options.use_intra_process_comm = rclcpp::IntraProcessSetting::Disable;
    return options;
  }

  void say(const std::string & what) {
    String text;
    text.data = what;
    report_->publish(text);
  }

  rclcpp::Publisher<String>::SharedPtr report_;
  rclcpp::Subscription<Image>::SharedPtr images_;
  rclcpp::Subscription<PoseStamped>::SharedPtr poses_;
  rclcpp::Subscription<String>::SharedPtr texts_;
  rclcpp::Subscription<TransformStamped>::SharedPtr in_;
};

}  // namespace judge

RCLCPP_COMPONENTS_REGISTER_NODE(judge::Talker)
RCLCPP_COMPONENTS_REGISTER_NODE(judge::Listener)
