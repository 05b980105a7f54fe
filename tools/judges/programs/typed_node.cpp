// A node of rclcpp that takes the commands of tests/integration/ros_client.py but "call"; "reliable" false asks for best
// effort.  It publishes C++ messages of any type with rcl_publish, as Publisher<T> does, and reads what it receives as
// C++ messages.  The introspection of each type decides how values become JSON and back.
#include <chrono>
#include <cstdlib>
#include <iostream>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <nlohmann/json.hpp>
#include <rcl/publisher.h>

#include "rclcpp/rclcpp.hpp"
#include "rclcpp/serialization.hpp"
#include "rclcpp/typesupport_helpers.hpp"
#include "rosidl_typesupport_introspection_cpp/field_types.hpp"
#include "rosidl_typesupport_introspection_cpp/message_introspection.hpp"

namespace types = rosidl_typesupport_introspection_cpp;
using nlohmann::json;
using Member = types::MessageMember;
using Members = types::MessageMembers;

static void say(const json & value) {
  static std::mutex printing;
  const std::lock_guard<std::mutex> lock(printing);
  std::cout << value.dump(-1, ' ', false, json::error_handler_t::replace) << std::endl;
}

static const Members & members_of(const rosidl_message_type_support_t * handle) {
  return *static_cast<const Members *>(handle->data);
}

static std::string hex_of(const std::vector<uint8_t> & bytes) {
  static const char digits[] = "0123456789abcdef";
  std::string text(2 * bytes.size(), '0');
  for (size_t i = 0; i < bytes.size(); ++i) {
    text[2 * i] = digits[bytes[i] >> 4];
    text[2 * i + 1] = digits[bytes[i] & 15];
  }
  return text;
}

static std::vector<uint8_t> bytes_of(const std::string & hex) {
  const auto digit = [](char c) { return c < 'a' ? c - '0' : c - 'a' + 10; };
  std::vector<uint8_t> bytes(hex.size() / 2);
  for (size_t i = 0; i < bytes.size(); ++i)
    bytes[i] = static_cast<uint8_t>(digit(hex[2 * i]) << 4 | digit(hex[2 * i + 1]));
  return bytes;
}

static bool is_byte(uint8_t type) { return type == types::ROS_TYPE_OCTET || type == types::ROS_TYPE_UINT8; }

static json read_message(const void * message, const Members & members);
static void write_message(void * message, const Members & members, const json & fields);

template<typename T> static T at(const void * place) { return *static_cast<const T *>(place); }

static json read_value(const void * place, const Member & member) {
  switch (member.type_id_) {
    case types::ROS_TYPE_MESSAGE: return read_message(place, members_of(member.members_));
    case types::ROS_TYPE_STRING: return at<std::string>(place);
    case types::ROS_TYPE_BOOLEAN: return at<bool>(place);
    case types::ROS_TYPE_OCTET: return {{"hex", hex_of({at<uint8_t>(place)})}};
    case types::ROS_TYPE_UINT8: case types::ROS_TYPE_CHAR: return at<uint8_t>(place);
    case types::ROS_TYPE_INT8: return at<int8_t>(place);
    case types::ROS_TYPE_UINT16: return at<uint16_t>(place);
    case types::ROS_TYPE_INT16: return at<int16_t>(place);
    case types::ROS_TYPE_UINT32: return at<uint32_t>(place);
    case types::ROS_TYPE_INT32: return at<int32_t>(place);
    case types::ROS_TYPE_UINT64: return at<uint64_t>(place);
    case types::ROS_TYPE_INT64: return at<int64_t>(place);
    case types::ROS_TYPE_FLOAT: return static_cast<double>(at<float>(place));
    case types::ROS_TYPE_DOUBLE: return at<double>(place);
    default: throw std::runtime_error(std::string("no such kind of field: ") + member.name_);
  }
}

template<typename T> static void put(void * place, const json & value) { *static_cast<T *>(place) = value.get<T>(); }

static void write_value(void * place, const Member & member, const json & value) {
  switch (member.type_id_) {
    case types::ROS_TYPE_MESSAGE: return write_message(place, members_of(member.members_), value);
    case types::ROS_TYPE_STRING: return put<std::string>(place, value);
    case types::ROS_TYPE_BOOLEAN: return put<bool>(place, value);
    case types::ROS_TYPE_OCTET: case types::ROS_TYPE_UINT8: case types::ROS_TYPE_CHAR:
      if (value.is_object()) *static_cast<uint8_t *>(place) = bytes_of(value["hex"]).at(0);
      else put<uint8_t>(place, value);
      return;
    case types::ROS_TYPE_INT8: return put<int8_t>(place, value);
    case types::ROS_TYPE_UINT16: return put<uint16_t>(place, value);
    case types::ROS_TYPE_INT16: return put<int16_t>(place, value);
    case types::ROS_TYPE_UINT32: return put<uint32_t>(place, value);
    case types::ROS_TYPE_INT32: return put<int32_t>(place, value);
    case types::ROS_TYPE_UINT64: return put<uint64_t>(place, value);
    case types::ROS_TYPE_INT64: return put<int64_t>(place, value);
    case types::ROS_TYPE_FLOAT: return put<float>(place, value);
    case types::ROS_TYPE_DOUBLE: return put<double>(place, value);
    default: throw std::runtime_error(std::string("no such kind of field: ") + member.name_);
  }
}

static bool is_sequence(const Member & member) { return member.resize_function != nullptr; }

static json read_message(const void * message, const Members & members) {
  json fields = json::object();
  for (uint32_t i = 0; i < members.member_count_; ++i) {
    const Member & member = members.members_[i];
    if (std::string(member.name_) == "structure_needs_at_least_one_member") continue;
    const void * place = static_cast<const char *>(message) + member.offset_;
    if (!member.is_array_) {
      fields[member.name_] = read_value(place, member);
      continue;
    }
    const size_t count = member.size_function(place);
    if (is_byte(member.type_id_) && is_sequence(member)) {
      const auto * first = count ? static_cast<const uint8_t *>(member.get_const_function(place, 0)) : nullptr;
      fields[member.name_] = {{"hex", hex_of(std::vector<uint8_t>(first, first + count))}};
      continue;
    }
    json & list = fields[member.name_] = json::array();
    for (size_t k = 0; k < count; ++k) list.push_back(read_value(member.get_const_function(place, k), member));
  }
  return fields;
}

static void write_message(void * message, const Members & members, const json & fields) {
  for (uint32_t i = 0; i < members.member_count_; ++i) {
    const Member & member = members.members_[i];
    const auto found = fields.find(member.name_);
    if (found == fields.end()) continue;
    void * place = static_cast<char *>(message) + member.offset_;
    if (!member.is_array_) {
      write_value(place, member, *found);
      continue;
    }
    json list = *found;
    if (list.is_object()) {
      const auto bytes = bytes_of(list["hex"]);
      if (is_sequence(member)) member.resize_function(place, bytes.size());
      if (!bytes.empty()) std::copy(bytes.begin(), bytes.end(), static_cast<uint8_t *>(member.get_function(place, 0)));
      continue;
    }
    if (is_sequence(member)) member.resize_function(place, list.size());
    for (size_t k = 0; k < list.size(); ++k) write_value(member.get_function(place, k), member, list[k]);
  }
}

// What belongs to a type by its name.
struct Type {
  explicit Type(const std::string & name)
  : library(rclcpp::get_typesupport_library(name, "rosidl_typesupport_cpp")),
    introspection(rclcpp::get_typesupport_library(name, "rosidl_typesupport_introspection_cpp")),
    handle(rclcpp::get_message_typesupport_handle(name, "rosidl_typesupport_cpp", *library)),
    members(members_of(
        rclcpp::get_message_typesupport_handle(name, "rosidl_typesupport_introspection_cpp", *introspection))),
    serialization(handle) {}

  std::shared_ptr<void> make() const {
    void * message = ::operator new(members.size_of_);
    members.init_function(message, rosidl_runtime_cpp::MessageInitialization::ALL);
    return {message, [fini = members.fini_function](void * each) { fini(each); ::operator delete(each); }};
  }

  std::shared_ptr<rcpputils::SharedLibrary> library, introspection;
  const rosidl_message_type_support_t * handle;
  const Members & members;
  rclcpp::SerializationBase serialization;
};

class Client {
public:
  explicit Client(const rclcpp::Node::SharedPtr & node) : node_(node) {}

  void obey(const json & command) {
    const std::string what = command["do"], topic = command["topic"];
    if (what == "subscribe") subscribe(topic, command);
    else if (what == "advertise") advertise(topic, command);
    else if (what == "readers") readers(topic, command["count"]);
    else if (what == "publish") publish(topic, command["fields"]);
    else if (what == "again") again(topic, command["sec"]);
    else throw std::runtime_error("no such command");
  }

private:
  struct Writer { std::shared_ptr<Type> type; rclcpp::GenericPublisher::SharedPtr publisher; std::shared_ptr<void> last; };

  static rclcpp::QoS quality(const json & command) {
    rclcpp::QoS qos(command.value("depth", 100));
    if (!command.value("reliable", true)) qos.best_effort();
    if (command.value("latched", false)) qos.transient_local();
    return qos;
  }

  std::shared_ptr<Type> type(const std::string & name) {
    auto & found = types_[name];
    if (!found) found = std::make_shared<Type>(name);
    return found;
  }

  void subscribe(const std::string & topic, const json & command) {
    const auto kind = type(command["type"]);
    subscriptions_.push_back(node_->create_generic_subscription(topic, command["type"], quality(command),
      [kind, topic](std::shared_ptr<rclcpp::SerializedMessage> data) {
        const auto message = kind->make();
        kind->serialization.deserialize_message(data.get(), message.get());
        say({{"topic", topic}, {"message", read_message(message.get(), kind->members)}});
      }));
  }

  void advertise(const std::string & topic, const json & command) {
    writers_[topic] = {type(command["type"]), node_->create_generic_publisher(topic, command["type"], quality(command)), {}};
  }

  void readers(const std::string & topic, size_t count) {
    const auto deadline = std::chrono::steady_clock::now() + std::chrono::seconds(20);
    while (writers_.at(topic).publisher->get_subscription_count() < count) {
      if (std::chrono::steady_clock::now() > deadline) throw std::runtime_error("too few readers");
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
  }

  void publish(const std::string & topic, const json & fields) {
    auto & writer = writers_.at(topic);
    writer.last = writer.type->make();
    write_message(writer.last.get(), writer.type->members, fields);
    send(writer);
  }

  void again(const std::string & topic, int sec) {
    auto & writer = writers_.at(topic);
    write_message(writer.last.get(), writer.type->members, {{"header", {{"stamp", {{"sec", sec}}}}}});
    send(writer);
  }

  static void send(const Writer & writer) {
    if (rcl_publish(writer.publisher->get_publisher_handle().get(), writer.last.get(), nullptr) != RCL_RET_OK)
      throw std::runtime_error(rcl_get_error_string().str);
  }

  rclcpp::Node::SharedPtr node_;
  std::map<std::string, std::shared_ptr<Type>> types_;
  std::map<std::string, Writer> writers_;
  std::vector<rclcpp::GenericSubscription::SharedPtr> subscriptions_;
};

int main(int, char ** words) {
  rclcpp::init(0, nullptr);
  const auto node = std::make_shared<rclcpp::Node>(words[1]);
  Client client(node);
  std::thread spinner([node] { rclcpp::spin(node); });
  for (std::string line; std::getline(std::cin, line);) {
    const json command = json::parse(line);
    try {
      client.obey(command);
      say({{"done", command["do"]}});
    } catch (const std::exception & error) {
      say({{"failed", command["do"].get<std::string>() + " " + command["topic"].get<std::string>() + ": " + error.what()}});
    }
  }
  rclcpp::shutdown();
  spinner.join();
}
