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

// Holds the last valid command when commands stop. A command is valid while it is finite, its age at the last check is at
// most the timeout, and it is at most one period in the future.
class Watchdog {
 public:
  Watchdog(double period, double timeout, int size) : min_age_(-(period + 1e-6)), timeout_(timeout), last_(size) {}

  void start(double time, const double* pose) {
    std::copy_n(pose, last_.size(), last_.begin());
    check_time_ = time;
  }

  // Checks a command (O,) with its time stamp [s] at a time [s], once per period; returns the pose to follow.
  const double* step(double time, const double* command, double stamp, const double* pose, bool is_controlled = true) {
    const int n = static_cast<int>(last_.size());
    if (!is_controlled) {
      if (is_finite(pose, n)) std::copy_n(pose, n, last_.begin());
    } else if (is_valid(time, command, stamp)) {
      std::copy_n(command, n, last_.begin());  // followed until now, even if it becomes stale now
    }
    check_time_ = time;
    has_timed_out_ = !is_valid(time, command, stamp);
    return has_timed_out_ ? last_.data() : command;
  }

  bool has_timed_out() const { return has_timed_out_; }

 private:
  bool is_valid(double time, const double* command, double stamp) const {
    for (std::size_t i = 0; i < last_.size(); ++i)
      if (!(std::abs(command[i]) <= 1e6)) return false;
    return check_time_ - stamp <= timeout_ && time - stamp >= min_age_;
  }

  double min_age_, timeout_, check_time_ = 0;
  bool has_timed_out_ = true;
  std::vector<double> last_;
};

}  // namespace guiderail
