// Double of the interfaces of ROS 2 that the skill's controller and node use, written from their public documentation:
// rclcpp, rclcpp_lifecycle, controller_interface, hardware_interface, pluginlib, and three packages of messages.
#pragma once

#include <chrono>
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <variant>
#include <vector>

namespace builtin_interfaces::msg {
struct Time {
  int sec = 0;
  unsigned nanosec = 0;
};
}  // namespace builtin_interfaces::msg

namespace rclcpp {

inline double clock_now = 0.0;  // time of all nodes, which the test sets [s]

class Time {
 public:
  explicit Time(double seconds = 0) : seconds_(seconds) {}
  double seconds() const { return seconds_; }
  operator builtin_interfaces::msg::Time() const { return {static_cast<int>(seconds_), 0}; }

 private:
  double seconds_;
};

class Duration {
 public:
  explicit Duration(double seconds) : seconds_(seconds) {}
  double seconds() const { return seconds_; }

 private:
  double seconds_;
};

struct NodeOptions {};
struct Logger {};
struct QoS {
  explicit QoS(int) {}
};
struct SensorDataQoS : QoS {
  SensorDataQoS() : QoS(5) {}
};

class Parameter {
 public:
  using Value = std::variant<bool, double, std::string, std::vector<double>, std::vector<std::string>>;
  Parameter() = default;
  explicit Parameter(Value value) : value_(std::move(value)) {}
  bool as_bool() const { return std::get<bool>(value_); }
  double as_double() const { return std::get<double>(value_); }
  std::string as_string() const { return std::get<std::string>(value_); }
  std::vector<double> as_double_array() const { return std::get<std::vector<double>>(value_); }
  std::vector<std::string> as_string_array() const { return std::get<std::vector<std::string>>(value_); }

 private:
  Value value_;
};

template <class Message>
class Subscription {
 public:
  using SharedPtr = std::shared_ptr<Subscription>;
  std::function<void(std::shared_ptr<Message>)> callback;
};

struct TimerBase {
  using SharedPtr = std::shared_ptr<TimerBase>;
  std::function<void()> callback;
};

}  // namespace rclcpp

#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::fprintf(stderr, __VA_ARGS__), std::fputc('\n', stderr))
#define RCLCPP_INFO(logger, ...) ((void)(logger), std::printf(__VA_ARGS__), std::putchar('\n'))

namespace rclcpp_lifecycle {

class State {};

namespace node_interfaces {
struct LifecycleNodeInterface {
  enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
};
}  // namespace node_interfaces

template <class Message>
class LifecyclePublisher {
 public:
  using SharedPtr = std::shared_ptr<LifecyclePublisher>;
  void publish(const Message& message) {
    last = message;
    ++count;
  }
  Message last;
  int count = 0;
};

class LifecycleNode {
 public:
  using CallbackReturn = node_interfaces::LifecycleNodeInterface::CallbackReturn;
  explicit LifecycleNode(const std::string&, const rclcpp::NodeOptions& = {}) {}
  virtual ~LifecycleNode() = default;
  void declare_parameter(const std::string& name, rclcpp::Parameter::Value value) { parameters[name] = std::move(value); }
  rclcpp::Parameter get_parameter(const std::string& name) const { return rclcpp::Parameter(parameters.at(name)); }
  rclcpp::Logger get_logger() const { return {}; }
  rclcpp::Time now() const { return rclcpp::Time(rclcpp::clock_now); }
  virtual CallbackReturn on_configure(const State&) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_cleanup(const State&) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_activate(const State&) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_deactivate(const State&) { return CallbackReturn::SUCCESS; }

  template <class Message>
  std::shared_ptr<LifecyclePublisher<Message>> create_publisher(const std::string& topic, const rclcpp::QoS&) {
    auto publisher = std::make_shared<LifecyclePublisher<Message>>();
    publishers[topic] = publisher;
    return publisher;
  }
  template <class Message, class Callback>
  std::shared_ptr<rclcpp::Subscription<Message>> create_subscription(const std::string& topic, const rclcpp::QoS&, Callback callback) {
    auto subscription = std::make_shared<rclcpp::Subscription<Message>>();
    subscription->callback = callback;
    subscriptions[topic] = subscription;
    return subscription;
  }
  template <class Period, class Callback>
  rclcpp::TimerBase::SharedPtr create_wall_timer(Period, Callback callback) {
    auto made = std::make_shared<rclcpp::TimerBase>();
    made->callback = callback;
    timer = made;
    return made;
  }

  std::map<std::string, rclcpp::Parameter::Value> parameters;
  std::map<std::string, std::shared_ptr<void>> publishers, subscriptions;
  std::weak_ptr<rclcpp::TimerBase> timer;
};

}  // namespace rclcpp_lifecycle

namespace hardware_interface {
class LoanedStateInterface {
 public:
  explicit LoanedStateInterface(const double* value) : value_(value) {}
  double get_value() const { return *value_; }

 private:
  const double* value_;
};
class LoanedCommandInterface {
 public:
  explicit LoanedCommandInterface(double* value) : value_(value) {}
  void set_value(double value) { *value_ = value; }

 private:
  double* value_;
};
}  // namespace hardware_interface

namespace controller_interface {
using CallbackReturn = rclcpp_lifecycle::node_interfaces::LifecycleNodeInterface::CallbackReturn;
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration {
  interface_configuration_type type;
  std::vector<std::string> names;
};
class ControllerInterface {
 public:
  virtual ~ControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State&) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State&) = 0;
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State&) = 0;
  virtual return_type update(const rclcpp::Time&, const rclcpp::Duration&) = 0;
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() const { return node_; }
  unsigned get_update_rate() const { return update_rate; }

  unsigned update_rate = 1000;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;
  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;

 private:
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_ = std::make_shared<rclcpp_lifecycle::LifecycleNode>("controller");
};
}  // namespace controller_interface

#define PLUGINLIB_EXPORT_CLASS(derived, base) static_assert(std::is_base_of_v<base, derived>);

namespace std_msgs::msg {
struct Header {
  builtin_interfaces::msg::Time stamp;
  std::string frame_id;
};
}  // namespace std_msgs::msg

namespace geometry_msgs::msg {
struct Point {
  double x = 0, y = 0, z = 0;
};
struct Quaternion {
  double x = 0, y = 0, z = 0, w = 1;
};
struct PoseStamped {
  using SharedPtr = std::shared_ptr<PoseStamped>;
  std_msgs::msg::Header header;
  struct {
    Point position;
    Quaternion orientation;
  } pose;
};
struct WrenchStamped {
  using SharedPtr = std::shared_ptr<WrenchStamped>;
  std_msgs::msg::Header header;
  struct {
    Point force, torque;
  } wrench;
};
}  // namespace geometry_msgs::msg

namespace diagnostic_msgs::msg {
struct DiagnosticStatus {
  static constexpr unsigned char OK = 0, WARN = 1, ERROR = 2, STALE = 3;
  unsigned char level = OK;
  std::string name, message;
};
struct DiagnosticArray {
  std_msgs::msg::Header header;
  std::vector<DiagnosticStatus> status;
};
}  // namespace diagnostic_msgs::msg
