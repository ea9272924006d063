// Runs the controller and the node of an exported skill with a double of ROS 2, against a tool that follows its targets.
#include <cassert>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <new>

static long allocations = 0;
__attribute__((noinline)) void* operator new(std::size_t size) {
  ++allocations;
  return std::malloc(size ? size : 1);
}
__attribute__((noinline)) void operator delete(void* memory) noexcept { std::free(memory); }
__attribute__((noinline)) void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

#include "skill_controller.cpp"
#include "skill_node.hpp"

#define CHECK(condition) \
  if (!(condition)) return std::fprintf(stderr, "line %d: %s\n", __LINE__, #condition), 1

using guiderail::RunnerState;
using Result = controller_interface::CallbackReturn;
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

// Pose (7,) in the base for a pose of the skill in the frame `frame`.
static void in_base(const std::vector<double>& frame, const double* pose, double* measured) {
  const guiderail::Transform X = guiderail::quaternion_to_transform(frame.data()) * guiderail::pose_to_transform(pose);
  const auto q = guiderail::quaternion(X.R);
  for (int i = 0; i < 3; ++i) measured[i] = X.p[i], measured[3 + i] = q[1 + i];
  measured[6] = q[0];
}

static int test_controller(const std::string& skill, const std::vector<double>& frame, const double* start) {
  guiderail::SkillController controller;
  CHECK(controller.on_init() == Result::SUCCESS);
  CHECK(controller.on_configure({}) == Result::ERROR);  // without interfaces
  auto& parameters = controller.get_node()->parameters;
  parameters["skill"] = skill;
  parameters["pose_interfaces"] = std::vector<std::string>(7, "pose");
  parameters["wrench_interfaces"] = std::vector<std::string>(6, "wrench");
  parameters["target_interfaces"] = std::vector<std::string>(7, "target");
  parameters["task_frame"] = frame;
  CHECK(controller.on_configure({}) == Result::SUCCESS);
  CHECK(controller.state_interface_configuration().names.size() == 13);
  CHECK(controller.command_interface_configuration().names.size() == 7);
  double measured[7], wrench[6] = {0, 0, 0, 0, 0, 0}, target[7];
  for (double& value : measured) value = kNaN, controller.state_interfaces_.emplace_back(&value);
  for (double& value : wrench) controller.state_interfaces_.emplace_back(&value);
  for (double& value : target) controller.command_interfaces_.emplace_back(&value);
  CHECK(controller.on_activate({}) == Result::ERROR);  // the pose is not finite
  in_base(frame, start, measured);
  CHECK(controller.on_activate({}) == Result::SUCCESS);

  const long before = allocations;
  double largest = 0, first[7];
  const int updates = static_cast<int>(1000 * controller.runner()->duration());
  for (int i = 0; i < updates; ++i) {
    wrench[2] = i % 700 < 200 ? 3.0 : 0.0;
    CHECK(controller.update(rclcpp::Time(0.001 * i), rclcpp::Duration(0.001)) == controller_interface::return_type::OK);
    if (i == 0) std::copy_n(target, 7, first);
    double step = 0;
    for (int j = 0; j < 3; ++j) step += (target[j] - measured[j]) * (target[j] - measured[j]);
    largest = std::max(largest, std::sqrt(step));
    for (int j = 0; j < 7; ++j) measured[j] += 0.05 * (target[j] - measured[j]);  // a slow impedance
  }
  CHECK(allocations == before);
  double moved = 0;
  for (int j = 0; j < 3; ++j) moved += (target[j] - first[j]) * (target[j] - first[j]);
  CHECK(std::sqrt(moved) > 1e-3);
  CHECK(largest < 0.05);
  measured[2] = kNaN;
  const double held = target[2];
  CHECK(controller.update(rclcpp::Time(9), rclcpp::Duration(0.001)) == controller_interface::return_type::ERROR);
  CHECK(target[2] == held && controller.runner()->state() == RunnerState::kStale);
  CHECK(controller.on_deactivate({}) == Result::SUCCESS);
  std::printf("controller: %d updates, moved %.1f mm, largest distance to the target %.1f mm, 0 allocations\n", updates, 1e3 * std::sqrt(moved),
              1e3 * largest);
  return 0;
}

static int test_node(const std::string& skill, const std::vector<double>& frame, const double* start) {
  using namespace geometry_msgs::msg;
  guiderail::SkillNode node;
  node.parameters["skill"] = std::string("missing.safetensors");
  CHECK(node.on_configure({}) == Result::FAILURE);
  node.parameters["skill"] = skill;
  node.parameters["task_frame"] = frame;
  CHECK(node.on_configure({}) == Result::SUCCESS);
  CHECK(node.on_activate({}) == Result::FAILURE);  // nothing was measured
  const auto measure = [&](double force) {
    double measured[7];
    in_base(frame, start, measured);
    auto pose = std::make_shared<PoseStamped>();
    pose->pose.position = {measured[0], measured[1], measured[2]};
    pose->pose.orientation = {measured[3], measured[4], measured[5], measured[6]};
    std::static_pointer_cast<rclcpp::Subscription<PoseStamped>>(node.subscriptions["current_pose"])->callback(pose);
    auto wrench = std::make_shared<WrenchStamped>();
    wrench->wrench.force.z = force;
    std::static_pointer_cast<rclcpp::Subscription<WrenchStamped>>(node.subscriptions["external_wrench"])->callback(wrench);
  };
  measure(0.0);
  CHECK(node.on_activate({}) == Result::SUCCESS);
  const auto targets = std::static_pointer_cast<rclcpp_lifecycle::LifecyclePublisher<PoseStamped>>(node.publishers["target_pose"]);
  using Diagnostics = diagnostic_msgs::msg::DiagnosticArray;
  const auto diagnostics = std::static_pointer_cast<rclcpp_lifecycle::LifecyclePublisher<Diagnostics>>(node.publishers["/diagnostics"]);
  for (int i = 0; i < 200; ++i) {
    rclcpp::clock_now += 0.005;
    measure(1.0);
    node.timer.lock()->callback();
  }
  CHECK(targets->count == 200 && diagnostics->count == 4 && diagnostics->last.status[0].level == 0);
  for (int i = 0; i < 50; ++i) {  // the measurements stop
    rclcpp::clock_now += 0.005;
    node.timer.lock()->callback();
  }
  CHECK(diagnostics->last.status[0].level == diagnostic_msgs::msg::DiagnosticStatus::ERROR);
  CHECK(node.on_deactivate({}) == Result::SUCCESS && node.timer.expired());
  CHECK(node.on_cleanup({}) == Result::SUCCESS);
  std::printf("node: %d targets, %d diagnostics\n", targets->count, diagnostics->count);
  return 0;
}

int main(int, char** argv) {
  const std::string skill = argv[1];
  const guiderail::Data data(skill), recording(argv[2]);
  const std::vector<double> frame{0.5, 0.1, 0.2, 0.0, 0.0, 0.3826834323650898, 0.9238795325112867};
  const double* start = recording.get("replay/pose").data();
  return test_controller(skill, frame, start) || test_node(skill, frame, start);
}
