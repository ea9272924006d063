// Solver of min ½‖v‖² subject to lower ≤ A v ≤ upper: a dual active-set method with bounded iterations.
//
// The method, its order of operations and its tolerances are those of DAQP (Arnström, Bemporad and Axehill 2022, "A dual
// active-set solver for embedded quadratic programming using recursive LDLᵀ updates", IEEE TAC 67(8)), which guiderail
// uses in Python, restricted to an identity Hessian and hard two-sided constraints. DAQP is Copyright (c) 2021 Daniel
// Arnström, MIT license; see LICENSE.daqp beside this file.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "guiderail/data.hpp"

namespace guiderail {

constexpr double kTolerance = 1e-9;  // largest accepted violation of a constraint by a command [unit of the output]

// Constraint rows, scaled to unit norm; `scaling` (rows,) is the factor of each row, 0 for a row of zeros.
struct Rows {
  const double* matrix;
  const double* scaling;
  int rows, cols, stride;
};

// Scales rows in place to unit norm, and writes the factors.
inline void normalize_rows(double* matrix, double* scaling, int rows, int cols, int stride) {
  for (int i = 0; i < rows; ++i) {
    double* row = matrix + static_cast<std::size_t>(i) * stride;
    double square = 0;
    for (int j = 0; j < cols; ++j) square += row[j] * row[j];
    scaling[i] = square < 1e-11 ? 0.0 : 1 / std::sqrt(square);
    if (scaling[i] != 0.0)
      for (int j = 0; j < cols; ++j) row[j] *= scaling[i];
  }
}

class LeastNorm {
 public:
  static constexpr int kMaxIterations = 500;  // of one attempt; a random step of the connector takes at most 13

  // Allocates buffers for at most this many rows and columns.
  LeastNorm(int max_rows, int max_cols)
      : sense_(max_rows), d_lower_(max_rows), d_upper_(max_rows), lower_(max_rows), upper_(max_rows),
        working_(max_cols + 2), L_((max_cols + 2) * (max_cols + 3) / 2), D_(max_cols + 2), x_(max_cols + 2),
        z_(max_cols + 2), lambda_(max_cols + 2), lambda_star_(max_cols + 2), u_(std::max(max_cols, 1)) {}

  // Finds v (cols,) for bounds (rows,) that exclude v = 0; returns false if no solution was found.
  bool solve(const Rows& rows, const double* lower, const double* upper, double* v) {
    iterations_ = 0;
    // The problem is homogeneous: at unit scale the tolerance is relative to the correction.
    double scale = -std::numeric_limits<double>::infinity(), lowest = std::numeric_limits<double>::infinity();
    for (int i = 0; i < rows.rows; ++i) scale = std::max(scale, lower[i]), lowest = std::min(lowest, upper[i]);
    scale = std::max(scale, -lowest);
    // Equal bounds are equations, which contradict each other by rounding: relax them a little until they do not.
    for (double relaxation : {0.0, 1e-10, 1e-9}) {
      for (int i = 0; i < rows.rows; ++i) {
        lower_[i] = lower[i] / scale - relaxation;
        upper_[i] = upper[i] / scale + relaxation;
      }
      for (double tolerance : {1e-12, 1e-10}) {
        if (!solve_scaled(rows, tolerance)) continue;
        for (int j = 0; j < rows.cols; ++j) v[j] = scale * u_[j];
        return true;
      }
    }
    return false;
  }

  // Number of iterations of the last call.
  int iterations() const { return iterations_; }

 private:
  static constexpr std::uint8_t kActive = 1, kLower = 2, kImmutable = 4;
  static constexpr int kEmpty = -1;
  static constexpr double kZero = 1e-11, kDual = 1e-12, kSingular = 3.7e-11, kPivot = 1e-6, kProgress = 1e-14;
  static constexpr double kRefactor = 1e-9;
  static constexpr int kCycles = 10;

  static int triangle(int n) { return n * (n + 1) / 2; }
  const double* row(int i) const { return rows_.matrix + static_cast<std::size_t>(i) * rows_.stride; }
  bool is_lower(int i) const { return sense_[i] & kLower; }
  void set_lower(int i, bool lower) { sense_[i] = lower ? sense_[i] | kLower : sense_[i] & ~kLower; }
  double bound(int i) const { return is_lower(i) ? d_lower_[i] : d_upper_[i]; }

  void reset() { singular_ = kEmpty, active_ = 0, reuse_ = 0; }

  // Sets the working set up; returns false if the bounds contradict each other.
  bool set_up(const Rows& rows, double tolerance) {
    rows_ = rows, tolerance_ = tolerance;
    reset();
    bool has_equations = false;
    for (int i = 0; i < rows.rows; ++i) {
      sense_[i] = 0;
      const double difference = upper_[i] - lower_[i];
      if (difference < -tolerance) return false;
      if (difference < kZero) sense_[i] = kActive | kImmutable, has_equations = true;
      if (rows.scaling[i] == 0.0) {  // a row of zeros constrains nothing
        if (!(sense_[i] & kImmutable) && (upper_[i] < -kZero || lower_[i] > kZero)) return false;
        sense_[i] = kImmutable;
      }
      const double scaling = rows.scaling[i] == 0.0 ? 1.0 : rows.scaling[i];
      d_lower_[i] = lower_[i] * scaling, d_upper_[i] = upper_[i] * scaling;
    }
    return !has_equations || activate();
  }

  // Adds the constraints that are marked as active to the working set.
  bool activate() {
    for (int i = 0; i < rows_.rows; ++i) {
      if (sense_[i] & kActive) add(i, is_lower(i) ? -1.0 : 1.0);
      if (singular_ == kEmpty) continue;
      const int last = working_[active_ - 1];
      if (sense_[last] & kImmutable) {  // a dependent equation: ignored if it is consistent
        compute_singular_direction();
        double residual = 0, size = 1;
        for (int j = 0; j < active_; ++j) {
          const double term = lambda_star_[j] * bound(working_[j]);
          residual += term, size += std::abs(term);
        }
        sense_[last] &= ~kActive;
        --active_;
        singular_ = kEmpty;
        reuse_ = std::min(reuse_, active_);
        if (std::abs(residual) <= tolerance_ * size) continue;
        return false;
      }
      bool is_possible = true;
      for (; i < rows_.rows; ++i) {
        if (!(sense_[i] & kActive)) continue;
        if (sense_[i] & kImmutable) is_possible = false;
        else sense_[i] &= ~kActive;
      }
      --active_;
      singular_ = kEmpty;
      return is_possible;
    }
    return true;
  }

  bool solve_scaled(const Rows& rows, double tolerance) {
    if (!set_up(rows, tolerance)) return false;
    bool was_repaired = false;
    int cycles = 0;
    double best = -1;
    for (int iteration = 1; iteration < kMaxIterations; ++iteration, ++iterations_) {
      if (singular_ != kEmpty) {
        compute_singular_direction();
        if (!remove_blocking()) return false;
        continue;
      }
      compute_multipliers();
      if (remove_blocking()) continue;
      const double value = compute_primal();
      if (!add_infeasible()) {
        double smallest = active_ > 0 ? D_[0] : 1.0;
        for (int i = 1; i < active_; ++i) smallest = std::min(smallest, D_[i]);
        if (active_ > 2 && !was_repaired && smallest < kRefactor) {  // a better order of the pivots
          was_repaired = true;
          for (int i = 0; i < active_; ++i) set_lower(working_[i], lambda_[i] < 0);
          reset();
          activate();
          continue;
        }
        if (active_ > 0 && smallest < kPivot) {
          refine();
          if (add_infeasible()) continue;
        }
        return true;
      }
      if (value - best >= kProgress) {
        best = value, cycles = 0;
      } else if (cycles++ > kCycles) {
        if (was_repaired) return false;
        was_repaired = true;
        reset();
        activate();
        cycles = 0, best = -1;
      }
    }
    return false;
  }

  // λ* of the working set: L D Lᵀ λ* = −d.
  void compute_multipliers() {
    int at = triangle(reuse_);
    for (int i = reuse_; i < active_; ++i) {
      double sum = -bound(working_[i]);
      for (int j = 0; j < i; ++j) sum -= L_[at++] * x_[j];
      ++at;
      x_[i] = sum;
    }
    for (int i = reuse_; i < active_; ++i) z_[i] = x_[i] / D_[i];
    back_substitute(z_.data(), lambda_star_.data(), active_);
    reuse_ = active_;
  }

  // Solves Lᵀ y = z for the first n rows.
  void back_substitute(const double* z, double* y, int n) const {
    int start = triangle(n) - 1;
    for (int i = n - 1; i >= 0; --i) {
      double sum = z[i];
      int at = start--;
      for (int j = n - 1; j > i; --j) {
        sum -= y[j] * L_[at];
        at -= j;
      }
      y[i] = sum;
    }
  }

  void compute_singular_direction() {
    const int last = singular_, offset = triangle(last);
    int start = offset - 1;
    for (int i = last - 1; i >= 0; --i) {
      double sum = -L_[offset + i];
      int at = start--;
      for (int j = last - 1; j > i; --j) {
        sum -= lambda_star_[j] * L_[at];
        at -= j;
      }
      lambda_star_[i] = sum;
    }
    lambda_star_[last] = 1;
    if (is_lower(working_[last]))
      for (int i = 0; i <= last; ++i) lambda_star_[i] = -lambda_star_[i];
  }

  // Removes the constraint whose multiplier changes its sign first; returns false if there is none.
  bool remove_blocking() {
    int removed = kEmpty;
    double alpha = 1e30;
    for (int i = 0; i < active_; ++i) {
      const int id = working_[i];
      if (sense_[id] & kImmutable) continue;
      if (is_lower(id) ? lambda_star_[i] < kDual : lambda_star_[i] > -kDual) continue;
      const double change = singular_ == kEmpty ? lambda_star_[i] - lambda_[i] : lambda_star_[i];
      const double candidate = -lambda_[i] / change;
      if (candidate < alpha) alpha = candidate, removed = i;
    }
    if (removed == kEmpty) return false;
    for (int i = 0; i < active_; ++i)
      lambda_[i] += alpha * (singular_ == kEmpty ? lambda_star_[i] - lambda_[i] : lambda_star_[i]);
    singular_ = kEmpty;
    remove(removed);
    return true;
  }

  // u = −Aᵀ λ*; returns ‖u‖².
  double compute_primal() {
    const int n = rows_.cols;
    for (int j = 0; j < n; ++j) u_[j] = 0;
    for (int i = 0; i < active_; ++i) {
      const double* a = row(working_[i]);
      const double multiplier = lambda_star_[i];
      for (int j = 0; j < n; ++j) u_[j] -= a[j] * multiplier;
    }
    double value = 0;
    for (int j = 0; j < n; ++j) value += u_[j] * u_[j];
    return value;
  }

  // Adds the most violated constraint; returns false if there is none.
  bool add_infeasible() {
    const int n = rows_.cols;
    int added = kEmpty;
    bool is_upper = false;
    double least = 0;
    for (int i = 0; i < rows_.rows; ++i) {
      if (sense_[i] & (kActive | kImmutable)) continue;
      const double* a = row(i);
      const double value = dot(a, u_.data(), n);
      const double limit = -tolerance_ * rows_.scaling[i];
      double slack = d_upper_[i] - value;
      if (slack < least && slack < limit) {
        added = i, is_upper = true, least = slack;
        continue;
      }
      slack = value - d_lower_[i];
      if (slack < least && slack < limit) added = i, is_upper = false, least = slack;
    }
    if (added == kEmpty) return false;
    set_lower(added, !is_upper);
    lambda_.swap(lambda_star_);
    add(added, is_upper ? 1.0 : -1.0);
    return true;
  }

  void add(int id, double multiplier) {
    sense_[id] |= kActive;
    factor_added(id);
    working_[active_] = id;
    lambda_[active_] = multiplier;
    ++active_;
    pivot_last();
  }

  void remove(int at) {
    sense_[working_[at]] &= ~kActive;
    factor_removed(at);
    --active_;
    for (int i = at; i < active_; ++i) working_[i] = working_[i + 1], lambda_[i] = lambda_[i + 1];
    reuse_ = std::min(reuse_, at);
    if (active_ > 0 && D_[active_ - 1] < kSingular) {
      singular_ = active_ - 1;
      D_[active_ - 1] = 0;
    } else {
      pivot_last();
    }
  }

  // Exchanges the last two constraints if this improves the conditioning.
  void pivot_last() {
    const int at = active_ - 2;
    if (active_ > 1 && D_[at] < kPivot && D_[at] < D_[active_ - 1]) {
      const int id = working_[at];
      const double multiplier = lambda_[at];
      remove(at);
      if (singular_ != kEmpty) return;
      add(id, multiplier);
    }
  }

  // Adds a row to L D Lᵀ = A Aᵀ of the working set.
  void factor_added(int id) {
    singular_ = kEmpty;
    const int n = rows_.cols, start = triangle(active_);
    const double* a = row(id);
    double sum = dot(a, a, n);
    D_[active_] = sum;
    if (active_ == 0) return;
    for (int i = 0; i < active_; ++i) L_[start + i] = dot(row(working_[i]), a, n);
    int at = 0;
    for (int i = 0; i < active_; ++i, ++at) {
      double value = L_[start + i];
      for (int j = 0; j < i; ++j) value -= L_[at++] * L_[start + j];
      L_[start + i] = value;
    }
    for (int i = 0; i < active_; ++i) {
      const double value = L_[start + i];
      L_[start + i] /= D_[i];
      sum -= value * L_[start + i];
    }
    D_[active_] = sum;
    if (sum < kSingular || active_ >= n) singular_ = active_, D_[active_] = 0;
  }

  // Removes a row from the factorization (algorithm C1 of Gill, Golub, Murray and Saunders 1974).
  void factor_removed(int removed) {
    if (active_ == removed + 1) return;
    double* w = z_.data() + removed;
    int to = triangle(removed), from = to + removed + 1, count = 0;
    const int updates = active_ - removed - 1;
    for (int i = removed + 1; i < active_; ++i, ++from, ++to) {
      for (int j = 0; j < i; ++j) {
        if (j != removed) L_[to++] = L_[from++];
        else w[count++] = L_[from++];
      }
    }
    double alpha = D_[removed];
    from = triangle(removed) + removed;
    for (int j = 0, i = removed + 1; j < updates; ++j, ++i) {
      const double p = w[j], d = D_[i] + alpha * p * p;
      D_[i - 1] = d;
      const double beta = p * alpha / d;
      alpha = D_[i] * alpha / d;
      from += i;
      to = from + j;
      for (int r = j + 1; r < updates; ++r) {
        w[r] -= p * L_[to];
        L_[to] += beta * w[r];
        to += removed + r + 1;
      }
    }
  }

  // One step of iterative refinement of λ* and u.
  void refine() {
    const int n = rows_.cols;
    reuse_ = 0;
    for (int i = 0; i < active_; ++i) {
      const double* a = row(working_[i]);
      double value = 0;
      for (int j = 0; j < n; ++j) value += a[j] * u_[j];
      x_[i] = value - bound(working_[i]);
    }
    int at = 0;
    for (int i = 0; i < active_; ++i, ++at) {
      double sum = x_[i];
      for (int j = 0; j < i; ++j) sum -= L_[at++] * x_[j];
      x_[i] = sum;
    }
    for (int i = 0; i < active_; ++i) z_[i] = x_[i] / D_[i];
    back_substitute(z_.data(), x_.data(), active_);
    for (int i = 0; i < active_; ++i) lambda_star_[i] += x_[i];
    for (int i = 0; i < active_; ++i) {
      const double* a = row(working_[i]);
      for (int j = 0; j < n; ++j) u_[j] -= a[j] * x_[i];
    }
  }

  Rows rows_{};
  double tolerance_ = 0;
  int active_ = 0, singular_ = kEmpty, reuse_ = 0, iterations_ = 0;
  std::vector<std::uint8_t> sense_;
  std::vector<double> d_lower_, d_upper_, lower_, upper_;
  std::vector<int> working_;
  std::vector<double> L_, D_, x_, z_, lambda_, lambda_star_, u_;
};

}  // namespace guiderail
