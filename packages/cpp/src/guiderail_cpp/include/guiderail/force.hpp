// Bounds of an impedance controller's wrench, the reference governor, and limits that follow the state of a template.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "guiderail/data.hpp"

namespace guiderail {

using Vec6 = std::array<double, 6>;
using Vec8 = std::array<double, 8>;

inline double norm_of(const double* v, int n = 3) {
  double square = v[0] * v[0];
  for (int i = 1; i < n; ++i) square = std::fma(v[i], v[i], square);
  return std::sqrt(square);
}
inline double product_of(const double* a, const double* b) { return std::fma(a[2], b[2], std::fma(a[1], b[1], a[0] * b[0])); }

// Limits per axis and of the norms of force and torque [N, Nm], the stiffness of the contact [N/m], and its largest
// distance from the tool center [m].
struct WrenchBound {
  Vec6 axes{};
  double force = 0, torque = 0, contact_stiffness = 0, contact_lever = 0;

  // Element-wise minimum of this bound and limits (8,) that arrive at run time; negative and NaN entries count as 0.
  WrenchBound lowered_to(const double* max_wrench) const {
    const auto lower = [](double own, double requested) { return std::min(own, requested > 0 ? requested : 0.0); };
    WrenchBound bound = *this;
    for (int i = 0; i < 6; ++i) bound.axes[i] = lower(axes[i], max_wrench[i]);
    bound.force = lower(force, max_wrench[6]);
    bound.torque = lower(torque, max_wrench[7]);
    return bound;
  }

  // The same bound with its axes in the order of a pose, [x y z Rz Ry Rx].
  WrenchBound in_pose_order() const {
    WrenchBound bound = *this;
    std::swap(bound.axes[3], bound.axes[5]);
    return bound;
  }
};

// Clips a wrench to limits per axis, then scales force and torque to the limits of their norms.
inline Vec6 clip_wrench(const Vec6& wrench, const Vec6& axes, double force, double torque) {
  Vec6 clipped;
  for (int i = 0; i < 6; ++i) {
    const double lower = std::isnan(wrench[i]) ? wrench[i] : std::max(wrench[i], -axes[i]);
    clipped[i] = std::isnan(lower) ? lower : std::min(lower, axes[i]);
  }
  for (int block = 0; block < 2; ++block) {
    double* part = clipped.data() + 3 * block;
    const double limit = block == 0 ? force : torque, magnitude = norm_of(part);
    if (magnitude > limit)
      for (int i = 0; i < 3; ++i) part[i] *= limit / magnitude;
  }
  return clipped;
}

inline double approach_impedance(double contact_stiffness, double mass) { return 2.0 * std::sqrt(contact_stiffness * mass); }

// Inertia that moves with a tool: a mass [kg] and a moment of inertia [kg m²].
struct MovingInertia {
  double mass = 1, moment = 1;
};

// Shortens a vector to at most the length `limit`, to zero if that is negative.
inline void shorten(double* vector, double limit) {
  const double length = norm_of(vector);
  if (!(length <= limit))
    for (int i = 0; i < 3; ++i) vector[i] *= std::max(0.0, limit) / length;
}

// Limits a spring's wrench so that no contact becomes faster than force / approach impedance.
inline void slow_down(Vec6& spring, const Vec6& damping, const double* velocity, const MovingInertia& inertia, const WrenchBound& bound) {
  double *s = spring.data(), *t = s + 3;
  const double *d = damping.data(), *w = velocity + 3;
  const double impedance = approach_impedance(bound.contact_stiffness, inertia.mass), lever = bound.contact_lever;
  const double speed = norm_of(velocity), turn = norm_of(w);
  if (product_of(s, velocity) > 0.0)
    shorten(s, bound.force - std::max(0.0, impedance * speed - product_of(d, velocity) / speed) - impedance * lever * turn);
  const double weight = lever * inertia.mass / inertia.moment;
  if (weight > 0.0 && product_of(t, w) > 0.0) {
    const double limit = bound.force - 0.5 * norm_of(s) - impedance * speed;
    shorten(t, (limit - std::max(0.0, impedance * lever * turn - weight * product_of(d + 3, w) / turn)) / weight);
  }
}

// Largest β in [0, 1] with s − β d inside the bound, for a spring s inside and a damper d.
inline double damping_share(const Vec6& spring, const Vec6& damping, const WrenchBound& bound) {
  Vec6 wrench;
  bool is_inside = true;
  for (int i = 0; i < 6; ++i) {
    wrench[i] = spring[i] - damping[i];
    is_inside = is_inside && std::abs(wrench[i]) <= bound.axes[i];
  }
  const double* f = wrench.data();
  if (is_inside && product_of(f, f) <= bound.force * bound.force && product_of(f + 3, f + 3) <= bound.torque * bound.torque) return 1.0;
  double share = 1.0;
  for (int i = 0; i < 6; ++i) {
    if (damping[i] == 0.0) continue;
    const double towards = damping[i] > 0.0 ? bound.axes[i] + spring[i] : bound.axes[i] - spring[i];
    share = std::min(share, towards / std::abs(damping[i]));
  }
  for (int block = 0; block < 2; ++block) {
    const double *s = spring.data() + 3 * block, *d = damping.data() + 3 * block;
    const double limit = block == 0 ? bound.force : bound.torque;
    const double dd = product_of(d, d), sd = product_of(s, d), slack = limit * limit - product_of(s, s);
    if (dd > 0.0 && std::isfinite(slack)) share = std::min(share, (sd + std::sqrt(std::max(sd * sd + dd * slack, 0.0))) / dd);
  }
  return std::max(share, 0.0);
}

// Wrench s − β d of a spring and a damper with the largest β ≤ 1 for which it is inside the bound.
inline Vec6 bounded_wrench(const Vec6& spring, const Vec6& damping, const double* velocity, const MovingInertia& inertia, const WrenchBound& bound) {
  Vec6 s = clip_wrench(spring, bound.axes, bound.force, bound.torque);
  Vec6 damper = damping;
  const double before = damping_share(s, damping, bound);
  for (double& value : damper) value *= before;
  slow_down(s, damper, velocity, inertia, bound);
  const double share = damping_share(s, damping, bound);
  for (int i = 0; i < 6; ++i) s[i] = s[i] - share * damping[i];
  return s;
}

// Reference governor: moves a desired pose towards the measured pose, so that the force of a spring and damper, which the
// robot's controller realizes, stays inside the bound.
class Governor {
 public:
  explicit Governor(const Data& data, const std::string& prefix = "governor/") {
    const Tensor &K = data.get(prefix + "stiffness"), &D = data.get(prefix + "damping"), &b = data.get(prefix + "bound");
    std::copy_n(K.values.begin(), 6, stiffness_.begin());
    std::copy_n(D.values.begin(), 6, damping_.begin());
    std::copy_n(b.values.begin(), 6, bound_.axes.begin());
    bound_.force = b.values.at(6), bound_.torque = b.values.at(7), bound_.contact_stiffness = b.values.at(8);
    bound_.contact_lever = b.values.at(9);
    inertia_.mass = data.number(prefix + "mass"), inertia_.moment = data.number(prefix + "moment");
    step_ = data.number(prefix + "step");
  }

  const WrenchBound& bound() const { return bound_; }

  // Computes the reference (6,) for a desired pose, the measured pose and its velocity. `max_wrench` (8,), or nullptr,
  // can lower the bound but not raise it.
  void apply(const double* desired, const double* pose, const double* velocity, const double* max_wrench, double* reference) const {
    const WrenchBound bound = (max_wrench ? bound_.lowered_to(max_wrench) : bound_).in_pose_order();
    Vec6 implicit, spring, damper, limits;
    for (int i = 0; i < 6; ++i) {
      implicit[i] = (stiffness_[i] * step_ + damping_[i]) * std::abs(velocity[i]);
      spring[i] = stiffness_[i] * (desired[i] - pose[i]);
      damper[i] = damping_[i] * velocity[i];
      limits[i] = std::max(bound.axes[i] - implicit[i], 0.0);
    }
    // A step from rest makes no contact faster than force / approach impedance.
    const double lever = approach_impedance(bound.contact_stiffness, inertia_.mass) * bound.contact_lever * step_;
    const double torque = lever > 0.0 ? std::min(bound.torque, bound.force * inertia_.moment / lever) : bound.torque;
    spring = clip_wrench(spring, bound.axes, bound.force, torque);
    slow_down(spring, damper, velocity, inertia_, bound);
    spring = clip_wrench(spring, limits, std::max(bound.force - norm_of(implicit.data()), 0.0),
                         std::max(bound.torque - norm_of(implicit.data() + 3), 0.0));
    for (int i = 0; i < 6; ++i) reference[i] = pose[i] + spring[i] / stiffness_[i];
  }

 private:
  Vec6 stiffness_{}, damping_{};
  WrenchBound bound_;
  MovingInertia inertia_;
  double step_ = 0;
};

// Wrench limit (8,) of a template's present state, with a bounded rate of change after a transition.
class PhaseWrenchLimit {
 public:
  explicit PhaseWrenchLimit(const Data& data, const std::string& prefix = "phase_limit/")
      : limits_(data.get(prefix + "limits")), max_change_(data.get(prefix + "max_change")) {}

  void start() { is_started_ = false; }

  // Computes the limit of a control step in a state; `max_wrench` (8,), or nullptr, is the limit of the task.
  const double* step(int state, const double* max_wrench) {
    const int n = static_cast<int>(limits_.dim(0));
    Vec8 target;
    for (int j = 0; j < 8; ++j) {
      target[j] = state >= 0 && state < n ? limits_[8 * state + j] : std::numeric_limits<double>::infinity();
      if (state < 0 || state >= n)
        for (int i = 0; i < n; ++i) target[j] = std::min(target[j], limits_[8 * i + j]);
    }
    if (!is_started_) bound_ = target;
    for (int j = 0; j < 8; ++j) output_[j] = !max_wrench || bound_[j] <= max_wrench[j] ? bound_[j] : max_wrench[j];
    is_started_ = true;
    approach(target);
    return output_.data();
  }

 private:
  // Moves the bound on a straight line towards the target.
  void approach(const Vec8& target) {
    double excess = 0;
    for (int j = 0; j < 8; ++j) excess = std::max(excess, std::abs(target[j] - bound_[j]) / max_change_[j]);
    for (int j = 0; j < 8; ++j) bound_[j] = excess <= 1.0 ? target[j] : bound_[j] + (target[j] - bound_[j]) / excess;
  }

  const Tensor limits_, max_change_;
  Vec8 bound_{}, output_{};
  bool is_started_ = false;
};

}  // namespace guiderail
