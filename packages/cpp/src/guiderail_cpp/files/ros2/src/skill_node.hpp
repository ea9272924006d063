// Lifecycle node that runs a skill between topics: a measured pose and wrench in, targets of a Cartesian controller and
// diagnostics out.
//
//   current_pose     PoseStamped      measured pose of the tool center in the robot's base [m], quaternion
//   external_wrench  WrenchStamped    wrench of the surroundings on the tool, about the tool center [N, Nm], in the axes of
//                                     the base, or of the tool if wrench_in_tool is true
//   target_pose      PoseStamped      target of the tool center, in the frame of current_pose
//   /diagnostics     DiagnosticArray  state of the skill, once per 50 targets
//
// Parameters: skill (path), task_frame (frame of the skill's poses in the base, [x y z qx qy qz qw]), wrench_in_tool,
// max_speed [m/s], max_angular_speed [rad/s], timeout [s] after which a measurement is stale, bound_force, update_rate [Hz].
// If measurements are stale or impossible, the last target is sent again. Messages are allocated: use the controller
// where the time of an update must be bounded.
#pragma once

#include <array>
#include <chrono>
#include <memory>
#include <string>
#include <vector>

#include "diagnostic_msgs/msg/diagnostic_array.hpp"
#include "geometry_msgs/msg/pose_stamped.hpp"
#include "geometry_msgs/msg/wrench_stamped.hpp"
#include "guiderail/runner.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/lifecycle_node.hpp"

namespace guiderail {

class SkillNode : public rclcpp_lifecycle::LifecycleNode {
 public:
  using CallbackReturn = rclcpp_lifecycle::node_interfaces::LifecycleNodeInterface::CallbackReturn;
  using Pose = geometry_msgs::msg::PoseStamped;
  using Wrench = geometry_msgs::msg::WrenchStamped;
  using Diagnostics = diagnostic_msgs::msg::DiagnosticArray;

  explicit SkillNode(const rclcpp::NodeOptions& options = rclcpp::NodeOptions()) : LifecycleNode("skill", options) {
    declare_parameter("skill", std::string());
    declare_parameter("task_frame", std::vector<double>{0, 0, 0, 0, 0, 0, 1});
    declare_parameter("wrench_in_tool", false);
    declare_parameter("max_speed", 0.25);
    declare_parameter("max_angular_speed", 1.5);
    declare_parameter("timeout", 0.1);
    declare_parameter("bound_force", true);
    declare_parameter("update_rate", 200.0);
  }

  CallbackReturn on_configure(const rclcpp_lifecycle::State&) override {
    RunnerSettings settings;
    const std::vector<double> frame = get_parameter("task_frame").as_double_array();
    const double rate = get_parameter("update_rate").as_double();
    if (frame.size() != 7 || !(rate > 0)) {
      RCLCPP_ERROR(get_logger(), "give a task_frame of 7 numbers and a positive update_rate");
      return CallbackReturn::FAILURE;
    }
    std::copy(frame.begin(), frame.end(), settings.task_frame.begin());
    settings.is_wrench_in_tool = get_parameter("wrench_in_tool").as_bool();
    settings.max_speed = get_parameter("max_speed").as_double();
    settings.max_angular_speed = get_parameter("max_angular_speed").as_double();
    settings.timeout = get_parameter("timeout").as_double();
    settings.bounds_force = get_parameter("bound_force").as_bool();
    settings.update_period = period_ = 1.0 / rate;
    try {
      runner_ = std::make_unique<Runner>(Data(get_parameter("skill").as_string()), settings);
    } catch (const std::exception& error) {
      RCLCPP_ERROR(get_logger(), "%s", error.what());
      return CallbackReturn::FAILURE;
    }
    const auto qos = rclcpp::SensorDataQoS();
    target_ = create_publisher<Pose>("target_pose", qos);
    diagnostics_ = create_publisher<Diagnostics>("/diagnostics", rclcpp::QoS(1));
    pose_subscription_ = create_subscription<Pose>("current_pose", qos, [this](const Pose::SharedPtr message) {
      const auto& p = message->pose.position;
      const auto& q = message->pose.orientation;
      pose_ = {p.x, p.y, p.z, q.x, q.y, q.z, q.w};
      frame_ = message->header.frame_id;
      pose_time_ = now().seconds();
    });
    wrench_subscription_ = create_subscription<Wrench>("external_wrench", qos, [this](const Wrench::SharedPtr message) {
      const auto &f = message->wrench.force, &t = message->wrench.torque;
      wrench_ = {f.x, f.y, f.z, t.x, t.y, t.z};
      wrench_time_ = now().seconds();
    });
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_activate(const rclcpp_lifecycle::State& state) override {
    LifecycleNode::on_activate(state);
    if (age() > get_parameter("timeout").as_double() || !runner_->start(pose_.data())) {
      RCLCPP_ERROR(get_logger(), "no present pose and wrench: start the robot's broadcasters first");
      return CallbackReturn::FAILURE;
    }
    timer_ = create_wall_timer(std::chrono::duration<double>(period_), [this] { update(); });
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_deactivate(const rclcpp_lifecycle::State& state) override {
    timer_.reset();
    return LifecycleNode::on_deactivate(state);
  }

  CallbackReturn on_cleanup(const rclcpp_lifecycle::State&) override {
    pose_subscription_.reset();
    wrench_subscription_.reset();
    runner_.reset();
    return CallbackReturn::SUCCESS;
  }

 private:
  double age() const { return now().seconds() - std::min(pose_time_, wrench_time_); }

  void update() {
    const double* target = runner_->update(period_, pose_.data(), wrench_.data(), age());
    Pose message;
    message.header.stamp = now();
    message.header.frame_id = frame_;
    message.pose.position.x = target[0], message.pose.position.y = target[1], message.pose.position.z = target[2];
    auto& q = message.pose.orientation;
    q.x = target[3], q.y = target[4], q.z = target[5], q.w = target[6];
    target_->publish(message);
    if (++count_ % 50 == 0) publish_diagnostics();
  }

  void publish_diagnostics() {
    diagnostic_msgs::msg::DiagnosticStatus status;
    const RunnerState state = runner_->state();
    status.name = "skill";
    status.message = runner_->description();
    status.level = state == RunnerState::kStale      ? diagnostic_msgs::msg::DiagnosticStatus::ERROR
                   : state == RunnerState::kFallback ? diagnostic_msgs::msg::DiagnosticStatus::WARN
                                                     : diagnostic_msgs::msg::DiagnosticStatus::OK;
    Diagnostics message;
    message.header.stamp = now();
    message.status.push_back(status);
    diagnostics_->publish(message);
  }

  std::unique_ptr<Runner> runner_;
  std::array<double, 7> pose_{};
  std::array<double, 6> wrench_{};
  std::string frame_;
  double pose_time_ = -1e9, wrench_time_ = -1e9, period_ = 0.005;
  long count_ = 0;
  rclcpp_lifecycle::LifecyclePublisher<Pose>::SharedPtr target_;
  rclcpp_lifecycle::LifecyclePublisher<Diagnostics>::SharedPtr diagnostics_;
  rclcpp::Subscription<Pose>::SharedPtr pose_subscription_;
  rclcpp::Subscription<Wrench>::SharedPtr wrench_subscription_;
  rclcpp::TimerBase::SharedPtr timer_;
};

}  // namespace guiderail
