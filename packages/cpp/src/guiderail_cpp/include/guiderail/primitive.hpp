// Movement primitive with linear constraints and null-space actions (LC-NS-KMP), for KGRL and sKGRL.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "guiderail/data.hpp"
#include "guiderail/least_norm.hpp"

namespace guiderail {

constexpr double kPi = 3.141592653589793;
constexpr double kUnconstrained = -1e30;  // violation if there is no constraint

// Linear constraints G y ≥ c with rows of unit norm, the same at every step or different from step to step.
class Constraints {
 public:
  explicit Constraints(const Data& data)
      : G_(data.get("constraints/G")), c_(data.get("constraints/c")), interior_(data.get("constraints/interior")),
        steps_(static_cast<int>(G_.dim(0))), rows_(static_cast<int>(G_.dim(1))), outputs_(static_cast<int>(G_.dim(2))),
        unit_(G_.values), scaling_(static_cast<std::size_t>(steps_) * rows_ + 1), lower_(rows_ + 1),
        upper_(rows_ + 1, std::numeric_limits<double>::infinity()), move_(outputs_), solver_(rows_ + 1, outputs_) {
    normalize_rows(unit_.data(), scaling_.data(), steps_ * rows_, outputs_, outputs_);
  }

  // Largest violation max(c − G y) of an output (O,) at a step; −inf without constraints.
  double violation(const double* output, int step) const {
    const int at = clipped(step);
    double worst = -std::numeric_limits<double>::infinity();
    for (int f = 0; f < rows_; ++f) {
      const double value = c(at)[f] - dot(G(at) + f * outputs_, output, outputs_);
      if (std::isnan(value)) return value;
      worst = std::max(worst, value);
    }
    return worst;
  }

  // Moves an output (O,) to the nearest one within the constraints of a step.
  void move_inside(double* output, int step) {
    if (violation(output, step) <= 0) return;
    const int at = clipped(step);
    for (int f = 0; f < rows_; ++f) lower_[f] = c(at)[f] - dot(G(at) + f * outputs_, output, outputs_);
    const std::size_t first = static_cast<std::size_t>(at) * rows_;
    const Rows rows{unit_.data() + first * outputs_, scaling_.data() + first, rows_, outputs_, outputs_};
    if (solver_.solve(rows, lower_.data(), upper_.data(), move_.data())) {
      for (int o = 0; o < outputs_; ++o) move_[o] += output[o];
      if (violation(move_.data(), step) <= kTolerance) {
        std::copy(move_.begin(), move_.end(), output);
        return;
      }
    }
    enter(output, at, step);
  }

  // Throws std::runtime_error if the arrays do not fit each other and the outputs.
  void check(const Data& data, int outputs) const {
    const std::vector<std::size_t> shape = data.get("constraints/G").shape;
    if (shape.size() != 3 || shape[0] == 0 || outputs_ != outputs) throw std::runtime_error("the constraints do not fit the outputs");
    data.get("constraints/c", {shape[0], shape[1]}), data.get("constraints/interior", {shape[0], shape[2]});
  }

 private:
  int clipped(int step) const { return std::min(std::max(step, 0), steps_ - 1); }
  const double* G(int at) const { return G_.data() + static_cast<std::size_t>(at) * rows_ * outputs_; }
  const double* c(int at) const { return c_.data() + static_cast<std::size_t>(at) * rows_; }

  // Moves an output to the first point within the constraints on the line to a point inside.
  void enter(double* output, int at, int step) {
    const double* inside = interior_.data() + static_cast<std::size_t>(at) * outputs_;
    double share = -std::numeric_limits<double>::infinity();
    for (int o = 0; o < outputs_; ++o) {
      bool is_free = true;
      for (int f = 0; f < rows_; ++f) is_free = is_free && G(at)[f * outputs_ + o] == 0.0;
      move_[o] = is_free ? 0.0 : inside[o] - output[o];
    }
    for (int f = 0; f < rows_; ++f) {
      const double missing = c(at)[f] - dot(G(at) + f * outputs_, output, outputs_);
      const double decrease = dot(G(at) + f * outputs_, move_.data(), outputs_);
      if (missing > 0.0) share = std::max(share, missing / std::max(decrease, missing));
    }
    for (int o = 0; o < outputs_; ++o) move_[o] = output[o] + share * move_[o];
    const bool is_inside = violation(move_.data(), step) <= kTolerance;
    for (int o = 0; o < outputs_; ++o) {
      bool is_free = true;
      for (int f = 0; f < rows_; ++f) is_free = is_free && G(at)[f * outputs_ + o] == 0.0;
      if (!is_free) output[o] = is_inside ? move_[o] : inside[o];
    }
  }

  const Tensor G_, c_, interior_;
  int steps_, rows_, outputs_;
  std::vector<double> unit_, scaling_, lower_, upper_, move_;
  LeastNorm solver_;
};

// Guidance by a movement primitive. Every step of the reference was factored when the skill was exported: a control step
// takes two matrix products, and a least-norm problem if a constraint of the window is violated.
class Primitive {
 public:
  explicit Primitive(const Data& data)
      : output_map_(data.get("primitive/output_map")), output_offset_(data.get("primitive/output_offset")),
        constraint_map_(data.get("primitive/constraint_map")), lower_bound_(data.get("primitive/lower")),
        upper_bound_(data.get("primitive/upper")), scale_(data.get("primitive/scale")),
        correction_map_(data.get("primitive/correction_map")), rank_(data.get("primitive/rank")),
        selection_(data.get("primitive/gain")), initial_(data.get("primitive/initial_command")),
        near_(data.get("primitive/first_mean")), rows_(data.get("primitive/constraint_rows").values),
        steps_(static_cast<int>(output_map_.dim(0))), outputs_(static_cast<int>(output_map_.dim(1))),
        inputs_(static_cast<int>(output_map_.dim(2))), directions_(static_cast<int>(lower_bound_.dim(1))),
        width_(static_cast<int>(correction_map_.dim(2))), actions_(static_cast<int>(selection_.dim(1))),
        is_measured_(data.number("primitive/is_measured") != 0.0),
        scaling_(static_cast<std::size_t>(steps_) * directions_ + 1), x_(inputs_), output_(outputs_), last_(outputs_),
        free_(directions_ + 1), lower_(directions_ + 1), upper_(directions_ + 1), v_(width_ + 1),
        constraints_(data), solver_(directions_ + 1, width_ + 1) {
    check(data);
    for (int n = 0; n < steps_; ++n) {
      const std::size_t first = static_cast<std::size_t>(n) * directions_;
      normalize_rows(rows_.data() + first * width_, scaling_.data() + first, directions_, static_cast<int>(rank_[n]), width_);
    }
  }

  int outputs() const { return outputs_; }
  int actions() const { return actions_; }
  int steps() const { return steps_; }
  int step_number() const { return step_; }

  // Begins an episode at a measured pose (O,).
  void start(const double* pose) {
    step_ = 0;
    is_started_ = false;
    std::copy(initial_.values.begin(), initial_.values.end(), last_.begin());
    const int past = inputs_ / outputs_ - 1;
    for (int p = 0; p < past; ++p) store(pose, near_.data(), p * outputs_);
  }

  // Computes the command of the next control step for an action (A,) and the measured pose (O,).
  Command step(const double* action, const double* pose) {
    const int split = inputs_ - outputs_;
    if (is_started_) {
      const double* newest = is_measured_ ? pose : output_.data();
      std::copy(output_.begin(), output_.end(), last_.begin());
      if (split > 0 && is_finite(newest, outputs_)) {
        std::copy(x_.begin() + outputs_, x_.begin() + split, x_.begin());
        store(newest, x_.data() + split - outputs_, split - outputs_);
      }
      ++step_;
    }
    is_started_ = true;
    for (int o = 0; o < outputs_; ++o) x_[split + o] = dot(selection_.data() + o * actions_, action, actions_);
    const bool is_solved = std::isfinite(dot(x_.data(), x_.data(), inputs_)) && predict(std::min(step_, steps_ - 1));
    if (!is_solved) {
      // The last command may violate the constraints of this step, which can differ from those of its own step.
      std::copy(last_.begin(), last_.end(), output_.begin());
      constraints_.move_inside(output_.data(), step_);
    }
    return {output_.data(), std::max(constraints_.violation(output_.data(), step_), kUnconstrained), !is_solved};
  }

  // Undoes the first step of an episode.
  void rewind() { is_started_ = false; }

  // True if a constraint of the last step's window was active.
  bool is_constrained() const { return is_constrained_; }
  int iterations() const { return is_constrained_ ? solver_.iterations() : 0; }

 private:
  // Throws std::runtime_error if the arrays do not fit each other.
  void check(const Data& data) const {
    const auto size = [](int value) { return static_cast<std::size_t>(value); };
    const std::size_t N = size(steps_), O = size(outputs_), I = size(inputs_), m = size(directions_), r = size(width_);
    data.get("primitive/output_map", {N, O, I}), data.get("primitive/output_offset", {N, O});
    data.get("primitive/constraint_map", {N, m, I}), data.get("primitive/correction_map", {N, O, r});
    data.get("primitive/constraint_rows", {N, m, r}), data.get("primitive/rank", {N});
    for (const char* name : {"lower", "upper", "scale"}) data.get(std::string("primitive/") + name, {N, m});
    for (const char* name : {"initial_command", "first_mean"}) data.get(std::string("primitive/") + name, {O});
    data.get("primitive/gain", {O, size(actions_)});
    for (double rank : rank_.values)
      if (!(rank >= 0 && rank <= width_)) throw std::runtime_error("the rank of a step is outside of its rows");
    if (N == 0 || O == 0 || I < O || I % O != 0) throw std::runtime_error("the primitive has no step, or its history does not fit its outputs");
    constraints_.check(data, outputs_);
  }

  // Stores an output in the history. Of the angles (a, b, c) and (a + pi, pi - b, c + pi) of a pose's orientation, each
  // plus full turns, it stores those nearest to the angles of `near`.
  void store(const double* output, const double* near, int at) {
    std::copy(output, output + outputs_, x_.begin() + at);
    if (outputs_ != 6) return;
    const double angles[3] = {output[3], output[4], output[5]};
    const double others[3] = {output[3] + kPi, kPi - output[4], output[5] + kPi};
    double first[3], second[3];
    const bool is_second = near_turns(others, near + 3, second) < near_turns(angles, near + 3, first);
    std::copy(is_second ? second : first, (is_second ? second : first) + 3, x_.begin() + at + 3);
  }

  // Writes angles on the full turns nearest to `near`, and returns their squared distance.
  static double near_turns(const double* angles, const double* near, double* result) {
    double squared = 0.0;
    for (int i = 0; i < 3; ++i) {
      result[i] = angles[i] - 2 * kPi * std::nearbyint((angles[i] - near[i]) / (2 * kPi));
      squared += (result[i] - near[i]) * (result[i] - near[i]);
    }
    return squared;
  }

  bool predict(int n) {
    const std::size_t first = static_cast<std::size_t>(n) * directions_;
    for (int o = 0; o < outputs_; ++o) {
      const std::size_t row = static_cast<std::size_t>(n) * outputs_ + o;
      output_[o] = dot(output_map_.data() + row * inputs_, x_.data(), inputs_) + output_offset_[row];
    }
    bool is_inside = true;
    for (int i = 0; i < directions_; ++i) {
      free_[i] = dot(constraint_map_.data() + (first + i) * inputs_, x_.data(), inputs_);
      is_inside = is_inside && free_[i] >= lower_bound_[first + i] && free_[i] <= upper_bound_[first + i];
    }
    is_constrained_ = !is_inside;
    if (is_inside) return true;
    const Rows rows{rows_.data() + first * width_, scaling_.data() + first, directions_, static_cast<int>(rank_[n]), width_};
    // If a correction hardly moves the output, rounding can make scaled bounds contradict each other: loosen them then.
    bool is_solved = false;
    for (double loose : {0.0, 0.5 * kTolerance}) {
      for (int i = 0; i < directions_; ++i) {
        lower_[i] = lower_bound_[first + i] - free_[i] - loose * scale_[first + i];
        upper_[i] = upper_bound_[first + i] - free_[i] + loose * scale_[first + i];
      }
      is_solved = solver_.solve(rows, lower_.data(), upper_.data(), v_.data());
      if (is_solved) break;
    }
    if (!is_solved) return false;
    for (int o = 0; o < outputs_; ++o)
      output_[o] += dot(correction_map_.data() + (static_cast<std::size_t>(n) * outputs_ + o) * width_, v_.data(), rows.cols);
    return constraints_.violation(output_.data(), n) <= kTolerance;
  }

  const Tensor output_map_, output_offset_, constraint_map_, lower_bound_, upper_bound_, scale_, correction_map_, rank_;
  const Tensor selection_, initial_, near_;
  std::vector<double> rows_;
  int steps_, outputs_, inputs_, directions_, width_, actions_;
  bool is_measured_;
  std::vector<double> scaling_, x_, output_, last_, free_, lower_, upper_, v_;
  Constraints constraints_;
  LeastNorm solver_;
  int step_ = 0;
  bool is_started_ = false, is_constrained_ = false;
};

}  // namespace guiderail
