// Controller of ros2_control that runs a skill: state interfaces of a pose and a wrench, command interfaces of a target.
//
// The target goes to the reference interfaces of a chained Cartesian controller. Parameters are listed in
// config/skill_controller.yaml. The interfaces, in their order:
//
//   pose_interfaces    7  measured pose of the tool center in the robot's base: position x y z [m], quaternion x y z w
//   wrench_interfaces  6  wrench of the surroundings on the tool, about the tool center: force [N], torque [Nm], in the axes
//                         of the base, or of the tool if wrench_in_tool is true
//   target_interfaces  7  target of the tool center in the robot's base, as the measured pose
//
// update() neither allocates, throws, locks nor logs, and its time is bounded. If a measurement is not finite, no pose, or a
// pose that the tool cannot have reached, it keeps the last target and returns ERROR. State interfaces have no time stamp:
// a sensor that repeats its last value is not noticed here, and the hardware component has to report it.
#include <array>
#include <chrono>
#include <memory>
#include <string>
#include <vector>

#include "controller_interface/controller_interface.hpp"
#include "guiderail/runner.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/state.hpp"

namespace guiderail {

using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::interface_configuration_type;
using controller_interface::return_type;

class SkillController : public controller_interface::ControllerInterface {
 public:
  CallbackReturn on_init() override {
    const auto node = get_node();
    node->declare_parameter("skill", std::string());
    node->declare_parameter("pose_interfaces", std::vector<std::string>());
    node->declare_parameter("wrench_interfaces", std::vector<std::string>());
    node->declare_parameter("target_interfaces", std::vector<std::string>());
    node->declare_parameter("task_frame", std::vector<double>{0, 0, 0, 0, 0, 0, 1});
    node->declare_parameter("wrench_in_tool", false);
    node->declare_parameter("max_speed", 0.25);
    node->declare_parameter("max_angular_speed", 1.5);
    node->declare_parameter("bound_force", true);
    return CallbackReturn::SUCCESS;
  }

  InterfaceConfiguration command_interface_configuration() const override { return {interface_configuration_type::INDIVIDUAL, targets_}; }
  InterfaceConfiguration state_interface_configuration() const override { return {interface_configuration_type::INDIVIDUAL, states_}; }

  // Reads the parameters and the data of the skill: everything that allocates or fails.
  CallbackReturn on_configure(const rclcpp_lifecycle::State&) override {
    const auto node = get_node();
    states_ = node->get_parameter("pose_interfaces").as_string_array();
    const std::vector<std::string> wrench = node->get_parameter("wrench_interfaces").as_string_array();
    targets_ = node->get_parameter("target_interfaces").as_string_array();
    const std::vector<double> frame = node->get_parameter("task_frame").as_double_array();
    if (states_.size() != 7 || wrench.size() != 6 || targets_.size() != 7 || frame.size() != 7 || get_update_rate() == 0) {
      RCLCPP_ERROR(node->get_logger(),
                   "give 7 pose_interfaces, 6 wrench_interfaces, 7 target_interfaces, a task_frame of 7 numbers and an update rate");
      return CallbackReturn::ERROR;
    }
    states_.insert(states_.end(), wrench.begin(), wrench.end());
    RunnerSettings settings;
    std::copy(frame.begin(), frame.end(), settings.task_frame.begin());
    settings.is_wrench_in_tool = node->get_parameter("wrench_in_tool").as_bool();
    settings.update_period = 1.0 / get_update_rate();
    settings.max_speed = node->get_parameter("max_speed").as_double();
    settings.max_angular_speed = node->get_parameter("max_angular_speed").as_double();
    settings.bounds_force = node->get_parameter("bound_force").as_bool();
    try {
      runner_ = std::make_unique<Runner>(Data(node->get_parameter("skill").as_string()), settings);
    } catch (const std::exception& error) {
      RCLCPP_ERROR(node->get_logger(), "%s", error.what());
      return CallbackReturn::ERROR;
    }
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_activate(const rclcpp_lifecycle::State&) override {
    read();
    if (!runner_->start(pose_.data())) {
      RCLCPP_ERROR(get_node()->get_logger(), "the pose is not finite: start the sensor first");
      return CallbackReturn::ERROR;
    }
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_deactivate(const rclcpp_lifecycle::State&) override {
    RCLCPP_INFO(get_node()->get_logger(), "%s; %ld fallbacks", runner_->description(), runner_->fallbacks());
    return CallbackReturn::SUCCESS;
  }

  return_type update(const rclcpp::Time&, const rclcpp::Duration& period) override {
    read();
    const double* target = runner_->update(period.seconds(), pose_.data(), wrench_.data(), 0.0);
    for (std::size_t i = 0; i < 7; ++i) command_interfaces_[i].set_value(target[i]);
    return runner_->state() == RunnerState::kStale ? return_type::ERROR : return_type::OK;
  }

  const Runner* runner() const { return runner_.get(); }

 private:
  void read() {
    for (std::size_t i = 0; i < 7; ++i) pose_[i] = state_interfaces_[i].get_value();
    for (std::size_t i = 0; i < 6; ++i) wrench_[i] = state_interfaces_[7 + i].get_value();
  }

  std::unique_ptr<Runner> runner_;
  std::vector<std::string> states_, targets_;
  std::array<double, 7> pose_{};
  std::array<double, 6> wrench_{};
};

}  // namespace guiderail

PLUGINLIB_EXPORT_CLASS(guiderail::SkillController, controller_interface::ControllerInterface)
