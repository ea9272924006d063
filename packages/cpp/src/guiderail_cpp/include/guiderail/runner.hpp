// Skill on a robot: frames, rate limit, force bound and watchdog around a skill, for a controller of any middleware.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <string>

#include "guiderail/filters.hpp"
#include "guiderail/force.hpp"
#include "guiderail/skill.hpp"
#include "guiderail/transforms.hpp"

namespace guiderail {

// Settings of a runner. Poses are X_BaseT, [x y z qx qy qz qw] in meters.
struct RunnerSettings {
  std::array<double, 7> task_frame{0, 0, 0, 0, 0, 0, 1};  // frame T of the skill's poses in the robot's base
  bool is_wrench_in_tool = false;                         // axes of the measured wrench: tool, or base
  double update_period = 0.001;                           // period of the updates [s]
  double max_speed = 0.25, max_angular_speed = 1.5;       // limits of the target [m/s, rad/s]
  double timeout = 0.1;                                   // age above which a measurement is stale [s]
  double max_tool_speed = 2.0, max_tool_angular_speed = 10.0;  // a measured pose that moved faster is none [m/s, rad/s]
  bool bounds_force = true;  // move the target towards the tool so that the force stays inside the skill's bound
};

enum class RunnerState { kIdle, kRunning, kFinished, kStale, kFallback };

inline const char* describe(RunnerState state) {
  switch (state) {
    case RunnerState::kIdle: return "idle";
    case RunnerState::kRunning: return "running";
    case RunnerState::kFinished: return "finished: the last target is held";
    case RunnerState::kStale: return "measurements are stale, impossible, or no pose and wrench: the last target is held";
    default: return "a safe pose is commanded instead of the requested one";
  }
}

inline Transform quaternion_to_transform(const double* pose) {
  const double n = 1.0 / std::sqrt(pose[3] * pose[3] + pose[4] * pose[4] + pose[5] * pose[5] + pose[6] * pose[6]);
  const double x = n * pose[3], y = n * pose[4], z = n * pose[5], w = n * pose[6];
  return {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
            2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}},
          {pose[0], pose[1], pose[2]}};
}

inline Transform inverse(const Transform& X) {
  const Mat3 R = transposed(X.R);
  const Vec3 p = R * X.p;
  return {R, {-p[0], -p[1], -p[2]}};
}

inline Transform operator*(const Transform& A, const Transform& B) { return {A.R * B.R, A.p + A.R * B.p}; }

// True for a finite pose (7,) whose quaternion has norm one, up to the rounding of single precision.
inline bool is_pose(const double* pose) {
  const double squared = pose[3] * pose[3] + pose[4] * pose[4] + pose[5] * pose[5] + pose[6] * pose[6];
  return is_finite(pose, 7) && std::abs(squared - 1.0) < 1e-3;
}

class Runner {
 public:
  Runner(const Data& data, const RunnerSettings& settings)
      : skill_(data), settings_(settings), X_BaseT_(quaternion_to_transform(settings.task_frame.data())), X_TBase_(inverse(X_BaseT_)),
        limiter_(settings.update_period, settings.max_speed, settings.max_angular_speed) {
    wrench_slot_ = skill_.signal("wrench"), wrench_size_ = skill_.signal_size("wrench");
    if (skill_.outputs() != 6) throw std::runtime_error("a skill on a robot commands poses of six coordinates");
    if (!is_pose(settings.task_frame.data())) throw std::runtime_error("the task frame is no pose with a quaternion of norm one");
    for (double value : {settings.max_speed, settings.max_angular_speed, settings.timeout, settings.max_tool_speed, settings.max_tool_angular_speed})
      if (!(value > 0 && std::isfinite(value))) throw std::runtime_error("limits of speed and timeout are positive numbers");
    if (!(settings.update_period > 0 && settings.update_period <= skill_.period() + 1e-9))
      throw std::runtime_error("the update period is positive, and at most the skill's period");
  }

  Skill& skill() { return skill_; }
  RunnerState state() const { return state_; }
  double duration() const { return skill_.duration(); }  // duration of an episode [s]
  const char* description() const { return describe(state_); }
  double violation() const { return violation_; }
  long fallbacks() const { return fallbacks_; }

  // Begins an episode at a measured pose (7,) in the base; returns false if it is no pose.
  bool start(const double* measured) {
    state_ = RunnerState::kIdle;
    if (!is_pose(measured)) return false;
    to_task(measured, pose_.data());
    skill_.start(pose_.data());
    limiter_.start(pose_.data());
    desired_ = last_pose_ = pose_;
    velocity_.fill(0.0);
    elapsed_ = 0.0, since_pose_ = 0.0, skill_time_ = 0.0, violation_ = 0.0, fallbacks_ = 0;
    to_base(pose_.data());
    state_ = RunnerState::kRunning;
    return true;
  }

  // Computes the target (7,) of an update `period` [s] after the last one, for the measured pose (7,) in the base and
  // wrench (6,), and their age [s]. While they are stale, no numbers, or a pose that the tool cannot have reached, the last
  // target is held, and the skill waits: a target beside a wrong pose would move the tool. A late update does not make
  // the skill faster: it never takes more than one step in an update.
  const double* update(double period, const double* measured, const double* wrench, double age) {
    if (state_ == RunnerState::kIdle) return target_.data();
    since_pose_ += period >= 0 ? period : 0.0;
    const bool is_stale = !(age <= settings_.timeout) || !(period >= 0) || !is_pose(measured) || !is_finite(wrench, 6);
    if (is_stale || !is_reachable(measured)) {
      state_ = RunnerState::kStale;
      return target_.data();
    }
    elapsed_ += std::min(period, skill_.period());
    to_task(measured, pose_.data());
    const std::array<double, 6> moved = pose_difference(pose_.data(), last_pose_.data());
    for (int i = 0; i < 6; ++i) velocity_[i] = period > 0 ? moved[i] / period : 0.0;
    last_pose_ = pose_;
    since_pose_ = 0.0;
    if (skill_.is_over()) {
      state_ = RunnerState::kFinished;
    } else if (elapsed_ + 1e-9 >= skill_time_) {
      write_wrench(wrench);
      const Command command = skill_.step(pose_.data());
      std::copy_n(command.pose, 6, desired_.begin());
      skill_time_ = std::max(skill_time_ + skill_.period(), elapsed_);
      violation_ = command.violation;
      fallbacks_ += command.fallback;
      state_ = command.fallback ? RunnerState::kFallback : RunnerState::kRunning;
    } else if (state_ == RunnerState::kStale) {
      state_ = RunnerState::kRunning;
    }
    const double* limited = limiter_.step(desired_.data(), pose_.data());
    if (settings_.bounds_force && skill_.governor()) {
      std::array<double, 6> near;  // the same orientation as the target, on the full turns nearest to the measured pose
      const std::array<double, 6> error = pose_difference(limited, pose_.data());
      for (int i = 0; i < 6; ++i) near[i] = pose_[i] + error[i];
      skill_.governor()->apply(near.data(), pose_.data(), velocity_.data(), skill_.max_wrench(nullptr), reference_.data());
      to_base(reference_.data());
    } else {
      to_base(limited);
    }
    return target_.data();
  }

 private:
  void to_task(const double* measured, double* pose) const { transform_to_pose(X_TBase_ * quaternion_to_transform(measured), pose); }

  // True if the tool can have moved to a measured pose (7,) since the last one, at most the timeout ago: after a larger
  // jump, the last target is held until the next start.
  bool is_reachable(const double* measured) const {
    const double time = std::min(since_pose_, settings_.timeout) + settings_.update_period;
    const Transform X = X_TBase_ * quaternion_to_transform(measured), last = pose_to_transform(last_pose_.data());
    return norm(X.p - last.p) <= settings_.max_tool_speed * time && angle_between(X.R, last.R) <= settings_.max_tool_angular_speed * time;
  }

  void to_base(const double* pose) {
    const Transform X = X_BaseT_ * pose_to_transform(pose);
    const std::array<double, 4> q = quaternion(X.R);
    target_ = {X.p[0], X.p[1], X.p[2], q[1], q[2], q[3], q[0]};
  }

  // Writes the wrench in the axes of T.
  void write_wrench(const double* wrench) {
    if (!wrench_slot_) return;
    const Mat3 R = settings_.is_wrench_in_tool ? pose_to_transform(pose_.data()).R : X_TBase_.R;
    const Vec3 force = R * Vec3{wrench[0], wrench[1], wrench[2]}, torque = R * Vec3{wrench[3], wrench[4], wrench[5]};
    for (int i = 0; i < wrench_size_; ++i) wrench_slot_[i] = i < 3 ? force[i] : torque[i - 3];
  }

  Skill skill_;
  RunnerSettings settings_;
  Transform X_BaseT_, X_TBase_;
  RateLimiter limiter_;
  RunnerState state_ = RunnerState::kIdle;
  std::array<double, 6> pose_{}, desired_{}, last_pose_{}, velocity_{}, reference_{};
  std::array<double, 7> target_{0, 0, 0, 0, 0, 0, 1};
  double elapsed_ = 0, since_pose_ = 0, skill_time_ = 0, violation_ = 0;
  long fallbacks_ = 0;
  double* wrench_slot_ = nullptr;
  int wrench_size_ = 0;
};

}  // namespace guiderail
