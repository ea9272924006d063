// Rate limiter of a desired pose, and watchdog of commands.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "guiderail/data.hpp"
#include "guiderail/transforms.hpp"

namespace guiderail {

// Follows a desired pose (6,) with limited speed: the position on a straight line, each angle in the shorter direction.
class RateLimiter {
 public:
  RateLimiter(double period, double speed, double angular_speed) : step_(speed * period), angular_step_(angular_speed * period) {}

  void start(const double* pose) { std::copy_n(pose, 6, last_.begin()); }

  // Computes the limited pose of a control step; while the robot is not controlled, it is the measured pose.
  const double* step(const double* desired, const double* pose, bool is_controlled = true) {
    if (!is_controlled) {
      if (is_finite(pose, 6)) std::copy_n(pose, 6, last_.begin());
      return last_.data();
    }
    if (!is_finite(desired, 6)) return last_.data();
    std::array<double, 6> change = pose_difference(desired, last_.data());
    const double distance = norm({change[0], change[1], change[2]});
    bool is_reachable = distance <= step_;
    for (int i = 3; i < 6; ++i) is_reachable = is_reachable && std::abs(change[i]) <= angular_step_;
    const double share = step_ / std::max(distance, step_);
    for (int i = 0; i < 6; ++i) {
      change[i] = i < 3 ? change[i] * share : std::min(std::max(change[i], -angular_step_), angular_step_);
      last_[i] = is_reachable ? desired[i] : last_[i] + change[i];
    }
    return last_.data();
  }

 private:
  double step_, angular_step_;
  std::array<double, 6> last_{};
};

// Holds the last valid command when commands stop. A command is valid while it is finite, its age is at most the timeout,
// and it is at most one period in the future.
class Watchdog {
 public:
  Watchdog(double period, double timeout, int size) : min_age_(-(period + 1e-6)), timeout_(timeout), last_(size) {}

  void start(const double* pose) { std::copy_n(pose, last_.size(), last_.begin()); }

  // Computes the pose to follow at a time [s] for a command (O,) with its time stamp [s].
  const double* step(double time, const double* command, double stamp, const double* pose, bool is_controlled = true) {
    const int n = static_cast<int>(last_.size());
    is_valid_ = time - stamp <= timeout_ && time - stamp >= min_age_;
    for (int i = 0; i < n; ++i) is_valid_ = is_valid_ && std::abs(command[i]) <= 1e6;
    if (!is_controlled) {
      if (is_finite(pose, n)) std::copy_n(pose, n, last_.begin());
      return is_valid_ ? command : last_.data();
    }
    if (is_valid_) std::copy_n(command, n, last_.begin());
    return last_.data();
  }

  bool has_timed_out() const { return !is_valid_; }

 private:
  double min_age_, timeout_;
  bool is_valid_ = false;
  std::vector<double> last_;
};

}  // namespace guiderail
