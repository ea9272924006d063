// Guidance by a shared control template: input mappings, active constraints and a state machine.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "guiderail/data.hpp"
#include "guiderail/transforms.hpp"

namespace guiderail {

constexpr int kMaxInputs = 32;  // of a template

// Numbers of the kinds of a template's parts; they are equal to those in guiderail_cpp/templates.py.
enum class MappingKind { kTranslation, kRotation, kTiltTowards };
enum class ConstraintKind {
  kHalfSpace, kBox, kCylinder, kSector, kKeepAbove, kFunnel, kFixedOrientation, kTiltLimits, kTiltByDistance,
  kOutsideSphere, kOutsideCylinder, kOutsideBox, kInsideSphere
};
enum class DistanceKind { kDistance, kHeight, kAxisDistance, kTiltToGo };

constexpr int kTool = -2, kWorld = -1;  // frames that are not those of objects

// Function that is linear between points and constant beyond them (numpy.interp).
inline double interpolate(double x, const double* xs, const double* ys, int n) {
  if (std::isnan(x)) return x;
  if (x <= xs[0]) return ys[0];
  if (x >= xs[n - 1]) return ys[n - 1];
  int j = 0;
  while (j + 2 < n && xs[j + 1] <= x) ++j;
  const double slope = (ys[j + 1] - ys[j]) / (xs[j + 1] - xs[j]);
  return slope * (x - xs[j]) + ys[j];
}

// Reads the numbers of a template one after the other.
class Reader {
 public:
  explicit Reader(const Tensor& numbers) : numbers_(numbers) {}
  double next() { return numbers_.values.at(at_++); }
  int whole() { return static_cast<int>(next()); }
  std::vector<double> list(int n) {
    std::vector<double> values(n);
    for (double& value : values) value = next();
    return values;
  }
  std::vector<double> list() { return list(whole()); }

 private:
  const Tensor& numbers_;
  std::size_t at_ = 0;
};

// Mapping with the scalings around it, outermost first.
struct Mapping {
  struct Scaling {
    double above, below;  // factors of positive and of negative inputs
  };
  std::vector<Scaling> scalings;
  MappingKind kind{};
  int frame = kWorld;
  double speed = 0;
  std::vector<int> inputs;
  std::vector<double> axes;  // three numbers for each input

  explicit Mapping(Reader& reader) {
    for (int n = reader.whole(); n > 0; --n) {
      Scaling scaling{};
      scaling.above = reader.next(), scaling.below = reader.next();
      scalings.push_back(scaling);
    }
    kind = static_cast<MappingKind>(reader.whole());
    frame = reader.whole();
    speed = reader.next();
    for (double input : reader.list()) inputs.push_back(static_cast<int>(input));
    axes = reader.list();
  }
};

struct Constraint {
  ConstraintKind kind{};
  int frame = kWorld;
  std::vector<double> numbers, xs, ys;

  explicit Constraint(Reader& reader) {
    kind = static_cast<ConstraintKind>(reader.whole());
    frame = reader.whole();
    numbers = reader.list();
    xs = reader.list();
    ys = reader.list();
  }
  bool is_outside() const {
    return kind == ConstraintKind::kOutsideSphere || kind == ConstraintKind::kOutsideCylinder || kind == ConstraintKind::kOutsideBox;
  }
};

struct Distance {
  DistanceKind kind{};
  int frame = kWorld;
  std::vector<double> numbers;

  explicit Distance(Reader& reader) {
    kind = static_cast<DistanceKind>(reader.whole());
    frame = reader.whole();
    numbers = reader.list();
  }
};

struct Exit {
  int source;
  double sign;
  int target;
  double threshold;
};

struct State {
  std::vector<Mapping> mappings;
  std::vector<Constraint> constraints;
  Distance distance;
  std::vector<Exit> exits;
  double max_speed, max_angular_speed;

  explicit State(Reader& reader)
      : mappings(read<Mapping>(reader)), constraints(read<Constraint>(reader)), distance(reader), exits(read_exits(reader)),
        max_speed(reader.next()), max_angular_speed(reader.next()) {}

 private:
  template <class Part>
  static std::vector<Part> read(Reader& reader) {
    std::vector<Part> parts;
    for (int n = reader.whole(); n > 0; --n) parts.emplace_back(reader);
    return parts;
  }
  static std::vector<Exit> read_exits(Reader& reader) {
    std::vector<Exit> exits;
    for (int n = reader.whole(); n > 0; --n) {
      const double source = reader.next(), sign = reader.next(), target = reader.next();
      exits.push_back({static_cast<int>(source), sign, static_cast<int>(target), reader.next()});
    }
    return exits;
  }
};

class Template {
 public:
  explicit Template(const Data& data, const std::string& prefix = "template/")
      : frames_(static_cast<std::size_t>(data.get(prefix + "frames").dim(0))), inputs_(data.whole(prefix + "inputs")),
        initial_(data.whole(prefix + "initial_state")) {
    Reader reader(data.get(prefix + "states"));
    for (int n = reader.whole(); n > 0; --n) states_.emplace_back(reader);
    const Tensor& poses = data.get(prefix + "frames");
    check(poses);
    for (std::size_t i = 0; i < frames_.size(); ++i) set_frame(static_cast<int>(i), poses.data() + 6 * i);
    std::size_t most = 0;
    for (const State& state : states_) most = std::max(most, state.constraints.size());
    tangents_.resize(most + 1);
  }

  int inputs() const { return inputs_; }
  int states() const { return static_cast<int>(states_.size()); }
  int initial_state() const { return initial_; }
  int frames() const { return static_cast<int>(frames_.size()); }

  // Moves the frame of an object to a pose (6,); a pose that is not finite, or of no frame, is ignored.
  void set_frame(int index, const double* pose) {
    if (index >= 0 && index < frames() && is_finite(pose, 6)) frames_[index] = pose_to_transform(pose);
  }

  // Requested pose: the displacement of one period for inputs (n,), applied to a pose.
  Transform request(int state, const double* inputs, const Transform& X, double period) const {
    std::array<double, kMaxInputs> u{};
    for (int i = 0; i < inputs_; ++i) u[i] = std::min(std::max(inputs[i], -1.0), 1.0);
    Transform total;
    for (const Mapping& mapping : states_[state].mappings) total = displace(total, displacement(mapping, u, X, period));
    return displace(X, total);
  }

  // Allowed pose that is reachable in one period and close to a request.
  Transform command(int state, const Transform& last, const Transform& request, double period) {
    double fraction = 1.0 / std::max(1.0, speed_ratio(state, last, request, period));
    const State& phase = states_[state];
    for (std::size_t i = 0; i < phase.constraints.size(); ++i)
      if (phase.constraints[i].is_outside()) tangents_[i] = tangent(phase.constraints[i], last);
    for (int attempt = 0; attempt < kBacktracks; ++attempt) {
      const Transform X = project(state, between(last, request, fraction), true);
      const double ratio = speed_ratio(state, last, X, period);
      if (ratio <= kMaxSpeedRatio && violation(state, X, true) <= kInside) return X;
      fraction *= ratio > kMaxSpeedRatio ? 0.98 / ratio : 0.5;
    }
    if (violation(state, last) <= kInside) return last;
    const Transform X = project(state, last, true);
    const double ratio = speed_ratio(state, last, X, period);
    return ratio <= kMaxSpeedRatio ? X : between(last, X, 1.0 / ratio);
  }

  // Largest violation of an active constraint [m or rad]; 0 inside.
  double violation(int state, const Transform& X, bool is_linearized = false) const {
    const std::vector<Constraint>& constraints = states_[state].constraints;
    double worst = 0;
    Mat3 R{};
    Vec3 p{};
    for (std::size_t i = 0; i < constraints.size(); ++i) {
      if (i == 0 || constraints[i].frame != constraints[i - 1].frame) enter_frame(constraints[i].frame, X, R, p);
      Mat3 projected_R = R;
      Vec3 projected_p = p;
      bool has_moved = false, has_turned = false;
      apply(constraints[i], static_cast<int>(i), is_linearized, projected_R, projected_p, has_moved, has_turned);
      for (const double value : {has_moved ? distance(projected_p, p) : 0.0, has_turned ? angle_between(projected_R, R) : 0.0}) {
        if (std::isnan(value)) return value;
        worst = std::max(worst, value);
      }
    }
    return worst;
  }

  // Distance of a state to its end [m or rad].
  double distance_to_go(int state, const Transform& X) const {
    const Distance& d = states_[state].distance;
    const std::vector<double>& k = d.numbers;
    Mat3 R{};
    Vec3 p{};
    enter_frame(d.frame, X, R, p);
    switch (d.kind) {
      case DistanceKind::kDistance: {
        const Vec3 offset = p - Vec3{k[0], k[1], k[2]};
        return std::sqrt(dot(offset, offset));
      }
      case DistanceKind::kHeight: return p[2];
      case DistanceKind::kAxisDistance: return std::hypot(p[0], p[1]);
      case DistanceKind::kTiltToGo: return k[0] - tilt(k[1] != 0.0, matrix(k, 2), heading(p), R);
    }
    return 0;
  }

  // State after `state`, at most one transition away; with a period, a state is entered only if one period suffices.
  int next_state(int state, const Transform& X, double period) const {
    for (const Exit& exit : states_[state].exits) {
      if (!(exit.sign * distance_to_go(exit.source, X) < exit.sign * exit.threshold)) continue;
      return period > 0 && !can_enter(exit.target, X, period) ? state : exit.target;
    }
    return state;
  }

  // State in which an episode begins at a pose.
  int state_at(const Transform& X) const {
    int state = initial_;
    for (std::size_t i = 0; i < states_.size(); ++i) state = next_state(state, X, 0);
    return state;
  }

 private:
  static constexpr double kMaxSpeedRatio = 1.0 + 1e-9, kInside = 1e-9, kNearAxis = 1e-9, kClearance = 1e-8;
  static constexpr int kBacktracks = 8;
  static constexpr double kTurn = 6.283185307179586;

  struct HalfSpace {
    Vec3 unit{};
    double offset = 0;
  };

  static Mat3 matrix(const std::vector<double>& numbers, int at) {
    Mat3 R;
    std::copy(numbers.begin() + at, numbers.begin() + at + 9, R.m.begin());
    return R;
  }

  static Transform displace(const Transform& X, const Transform& displacement) {
    return {displacement.R * X.R, X.p + displacement.p};
  }

  void enter_frame(int frame, const Transform& X, Mat3& R, Vec3& p) const {
    if (frame == kWorld) {
      R = X.R, p = X.p;
    } else {
      p = transposed_product(frames_[frame].R, X.p - frames_[frame].p);
      R = transposed(frames_[frame].R) * X.R;
    }
  }

  Mat3 axes(int frame, const Transform& X) const {
    return frame == kTool ? X.R : frame == kWorld ? Mat3{} : frames_[frame].R;
  }

  Vec3 position_in(int frame, const Transform& X) const {
    return frame == kWorld ? X.p : transposed_product(frames_[frame].R, X.p - frames_[frame].p);
  }

  static Vec3 bearing(const Vec3& p) {
    const double horizontal = hypotenuse(p[0], p[1]);
    if (horizontal < kNearAxis) return {1, 0, 0};
    return {-p[0] / horizontal, -p[1] / horizontal, 0};
  }

  Transform displacement(const Mapping& mapping, std::array<double, kMaxInputs> u, const Transform& X, double period) const {
    for (const Mapping::Scaling& scaling : mapping.scalings) {
      for (int i = 0; i < inputs_; ++i) u[i] = (u[i] < 0.0 ? scaling.below : scaling.above) * u[i];
    }
    if (mapping.kind == MappingKind::kTiltTowards) {
      const Vec3 p = position_in(mapping.frame, X), towards = bearing(p);
      const double product = std::fma(u[mapping.inputs[1]], towards[1], u[mapping.inputs[0]] * towards[0]);
      const double along = std::min(std::max(product, -1.0), 1.0);
      const Vec3 axis = axes(mapping.frame, X) * Vec3{-towards[1], towards[0], 0};
      return {axis_angle_rotation(axis, along * mapping.speed * period), {0, 0, 0}};
    }
    Vec3 v{0, 0, 0};
    for (std::size_t i = 0; i < mapping.inputs.size(); ++i)
      for (int j = 0; j < 3; ++j) {
        const double scaled = mapping.speed * mapping.axes[3 * i + j], input = u[mapping.inputs[i]];
        v[j] = i == 0 ? scaled * input : std::fma(scaled, input, v[j]);
      }
    const Vec3 moved = period * (axes(mapping.frame, X) * v);
    if (mapping.kind == MappingKind::kTranslation) return {Mat3{}, moved};
    const double angle = norm(moved);
    return {angle == 0 ? Mat3{} : axis_angle_rotation(moved / angle, angle), {0, 0, 0}};
  }

  double speed_ratio(int state, const Transform& last, const Transform& X, double period) const {
    const Vec3 d = X.p - last.p;
    const double linear = std::sqrt(dot(d, d)) / (states_[state].max_speed * period);
    const double angular = angle_between(last.R, X.R) / (states_[state].max_angular_speed * period);
    return angular > linear ? angular : linear;
  }

  bool can_enter(int state, const Transform& last, double period) const {
    const Transform X = project(state, last, false);
    return speed_ratio(state, last, X, period) <= kMaxSpeedRatio && violation(state, X) <= kInside;
  }

  // Pose after the active constraints of a state in their order; constraints in the same frame form a group.
  Transform project(int state, Transform X, bool is_linearized) const {
    const std::vector<Constraint>& constraints = states_[state].constraints;
    for (std::size_t i = 0; i < constraints.size();) {
      const int frame = constraints[i].frame;
      Mat3 R{};
      Vec3 p{};
      enter_frame(frame, X, R, p);
      bool has_moved = false, has_turned = false;
      for (; i < constraints.size() && constraints[i].frame == frame; ++i)
        apply(constraints[i], static_cast<int>(i), is_linearized, R, p, has_moved, has_turned);
      if (has_moved) X.p = frame == kWorld ? p : frames_[frame].p + frames_[frame].R * p;
      if (has_turned) X.R = (frame == kWorld ? Mat3{} : frames_[frame].R) * R;
    }
    return X;
  }

  static double nearest_turn(double angle, double center) {
    const double turns = (angle - center) / kTurn;
    return std::isfinite(turns) ? angle - kTurn * std::nearbyint(turns) : std::numeric_limits<double>::quiet_NaN();
  }

  static double nudge(double lower, double upper) { return std::min(1e-12, 0.25 * (upper - lower)); }

  static Mat3 heading(const Vec3& p) {
    const Vec3 b = bearing(p);
    return {{b[0], -b[1], 0, b[1], b[0], 0, 0, 0, 1}};
  }

  static double tilt(bool turns_along, const Mat3& rest, const Mat3& R_FH, const Mat3& R_FE) {
    Mat3 R = transposed(R_FH) * R_FE * transposed(rest);
    if (!turns_along) R = R * R_FH;
    return std::atan2(R(0, 2) - R(2, 0), R(0, 0) + R(2, 2));
  }

  struct Surface {
    double distance;
    Vec3 normal;
  };

  static Vec3 perpendicular(const Vec3& axis) {
    int least = 0;
    for (int i = 1; i < 3; ++i)
      if (std::abs(axis[i]) < std::abs(axis[least])) least = i;
    Vec3 e{0, 0, 0};
    e[least] = 1;
    const Vec3 other{axis[1] * e[2] - axis[2] * e[1], axis[2] * e[0] - axis[0] * e[2], axis[0] * e[1] - axis[1] * e[0]};
    return other / norm(other);
  }

  static Surface surface(const Constraint& constraint, const Vec3& p) {
    const std::vector<double>& k = constraint.numbers;
    if (constraint.kind == ConstraintKind::kOutsideSphere) {
      const Vec3 offset = p - Vec3{k[0], k[1], k[2]};
      const double length = std::sqrt(dot(offset, offset));
      return {length - k[3] - k[4], length > 0 ? offset / length : Vec3{1, 0, 0}};
    }
    if (constraint.kind == ConstraintKind::kOutsideBox) {
      Vec3 offset;
      for (int i = 0; i < 3; ++i) offset[i] = p[i] - std::min(std::max(p[i], k[i]), k[3 + i]);
      const double length = std::sqrt(dot(offset, offset));
      if (length > 0) return {length - k[6], offset / length};
      int face = 0;
      std::array<double, 6> depths;
      for (int i = 0; i < 3; ++i) depths[i] = p[i] - k[i], depths[3 + i] = k[3 + i] - p[i];
      for (int i = 1; i < 6; ++i)
        if (depths[i] < depths[face]) face = i;
      Vec3 normal{0, 0, 0};
      normal[face % 3] = face < 3 ? -1.0 : 1.0;
      return {-depths[face] - k[6], normal};
    }
    const Vec3 start{k[0], k[1], k[2]}, axis{k[3], k[4], k[5]};
    const double length = k[6], limit = k[7], margin = k[8];
    const double along = dot(axis, p - start);
    const Vec3 across = p - start - along * axis;
    const double radius = std::sqrt(dot(across, across));
    const Vec3 outward = radius > 0 ? across / radius : perpendicular(axis);
    const double beyond_side = radius - limit, beyond_face = std::max(-along, along - length);
    const Vec3 face = along > 0.5 * length ? axis : Vec3{-axis[0], -axis[1], -axis[2]};
    if (beyond_side > 0 && beyond_face > 0) {
      const double size = hypotenuse(beyond_side, beyond_face);
      return {size - margin, (beyond_side * outward + beyond_face * face) / size};
    }
    if (beyond_side > beyond_face) return {beyond_side - margin, outward};
    return {beyond_face - margin, face};
  }

  // Half-space of allowed positions for the command after a last command.
  HalfSpace tangent(const Constraint& constraint, const Transform& last) const {
    const Vec3 p = position_in(constraint.frame, last);
    const Surface at = surface(constraint, p);
    return {at.normal / norm(at.normal), dot(at.normal, p) - at.distance + kClearance};
  }

  static void keep(const HalfSpace& half_space, Vec3& p, bool& has_moved) {
    const double shortfall = half_space.offset - dot(half_space.unit, p);
    if (!(shortfall <= 0)) p = p + shortfall * half_space.unit, has_moved = true;
  }

  // Applies one constraint to a pose in its frame.
  void apply(const Constraint& c, int index, bool is_linearized, Mat3& R, Vec3& p, bool& has_moved, bool& has_turned) const {
    const std::vector<double>& k = c.numbers;
    if (c.is_outside()) {
      if (is_linearized) return keep(tangents_[index], p, has_moved);
      const Surface at = surface(c, p);
      if (!(at.distance >= 0)) p = p + (kClearance - at.distance) * at.normal, has_moved = true;
      return;
    }
    switch (c.kind) {
      case ConstraintKind::kHalfSpace: return keep({{k[0], k[1], k[2]}, k[3]}, p, has_moved);
      case ConstraintKind::kBox: {
        bool is_inside = true;
        for (int i = 0; i < 3; ++i) is_inside = is_inside && k[i] <= p[i] && p[i] <= k[3 + i];
        if (is_inside) return;
        for (int i = 0; i < 3; ++i) p[i] = std::isnan(p[i]) ? p[i] : std::min(std::max(p[i], k[i]), k[3 + i]);
        has_moved = true;
        return;
      }
      case ConstraintKind::kCylinder: {
        const double radius = hypotenuse(p[0], p[1]);
        if (k[0] <= radius && radius <= k[1]) return;
        const double inward = nudge(k[0], k[1]), bound = radius < k[0] ? k[0] + inward : k[1] - inward;
        const double x = radius > 0 ? p[0] / radius : -1.0, y = radius > 0 ? p[1] / radius : 0.0;
        p[0] = bound * x, p[1] = bound * y, has_moved = true;
        return;
      }
      case ConstraintKind::kSector: {
        double azimuth = nearest_turn(std::atan2(p[1], p[0]), 0.5 * (k[0] + k[1]));
        if (k[0] <= azimuth && azimuth <= k[1]) return;
        const double inward = nudge(k[0], k[1]), radius = hypotenuse(p[0], p[1]);
        azimuth = azimuth < k[0] ? k[0] + inward : k[1] - inward;
        p[0] = radius * std::cos(azimuth), p[1] = radius * std::sin(azimuth), has_moved = true;
        return;
      }
      case ConstraintKind::kKeepAbove: {
        double lowest = std::numeric_limits<double>::infinity();
        for (std::size_t i = 0; i < c.xs.size(); i += 3) {
          const double height = dot3(R(2, 0), c.xs[i], R(2, 1), c.xs[i + 1], R(2, 2), c.xs[i + 2]);
          lowest = std::isnan(height) ? height : std::min(lowest, height);
        }
        const double shortfall = k[0] - (lowest + p[2]);
        if (!(shortfall <= 0)) p[2] = p[2] + shortfall, has_moved = true;
        return;
      }
      case ConstraintKind::kFunnel: {
        const double ceiling = k[1] + k[2] * std::max(0.0, hypotenuse(p[0], p[1]) - k[0]);
        if (!(p[2] <= ceiling)) p[2] = ceiling, has_moved = true;
        return;
      }
      case ConstraintKind::kFixedOrientation: R = matrix(k, 0), has_turned = true; return;
      case ConstraintKind::kTiltLimits:
      case ConstraintKind::kTiltByDistance: {
        const Mat3 R_FH = heading(p), rest = matrix(k, 1);
        double lower, upper;
        if (c.kind == ConstraintKind::kTiltLimits) {
          lower = k[10], upper = k[11];
        } else {
          const double degrees = interpolate(std::sqrt(dot(p, p)), c.xs.data(), c.ys.data(), static_cast<int>(c.xs.size()));
          lower = upper = degrees * (3.141592653589793 / 180.0);
        }
        double angle = nearest_turn(tilt(k[0] != 0.0, rest, R_FH, R), 0.5 * (lower + upper));
        angle = std::isnan(angle) ? angle : std::min(std::max(angle, lower), upper);
        const double cosine = std::cos(angle), sine = std::sin(angle);
        Mat3 turned = R_FH * Mat3{{cosine, 0, sine, 0, 1, 0, -sine, 0, cosine}};
        if (k[0] == 0.0) turned = turned * transposed(R_FH);
        R = turned * rest, has_turned = true;
        return;
      }
      case ConstraintKind::kInsideSphere: {
        const Vec3 center{k[0], k[1], k[2]}, offset = p - center;
        const double away = std::sqrt(dot(offset, offset));
        if (away <= k[3]) return;
        p = center + (k[3] - std::min(1e-12, 0.25 * k[3])) / away * offset, has_moved = true;
        return;
      }
      default: return;
    }
  }

  // Throws std::runtime_error if a number refers to nothing, or a part has too few numbers.
  void check(const Tensor& poses) const {
    static constexpr std::size_t kConstraint[] = {4, 6, 2, 2, 1, 3, 9, 12, 10, 5, 9, 7, 4}, kDistance[] = {3, 0, 0, 11};
    const auto require = [](bool condition) {
      if (!condition) throw std::runtime_error("the template of the skill is damaged: export the skill again");
    };
    const auto is_of = [](auto kind, std::size_t kinds) { return static_cast<int>(kind) >= 0 && static_cast<std::size_t>(kind) < kinds; };
    const auto check_frame = [&](int frame) { require(frame >= kTool && frame < frames()); };
    require(poses.size() == 6 * frames_.size() && inputs_ >= 1 && inputs_ <= kMaxInputs && initial_ >= 0 && initial_ < states());
    for (const State& state : states_) {
      require(state.max_speed > 0 && state.max_angular_speed > 0);
      for (const Mapping& mapping : state.mappings) {
        require(is_of(mapping.kind, 3));
        check_frame(mapping.frame);
        for (int input : mapping.inputs) require(input >= 0 && input < inputs_);
        const bool is_tilt = mapping.kind == MappingKind::kTiltTowards;
        require(is_tilt ? mapping.inputs.size() == 2 : mapping.axes.size() == 3 * mapping.inputs.size());
      }
      for (const Constraint& constraint : state.constraints) {
        require(is_of(constraint.kind, 13) && constraint.numbers.size() >= kConstraint[static_cast<int>(constraint.kind)]);
        check_frame(constraint.frame);
        require(constraint.kind != ConstraintKind::kKeepAbove || constraint.xs.size() % 3 == 0);
        require(constraint.kind != ConstraintKind::kTiltByDistance || (!constraint.xs.empty() && constraint.xs.size() == constraint.ys.size()));
      }
      require(is_of(state.distance.kind, 4) && state.distance.numbers.size() >= kDistance[static_cast<int>(state.distance.kind)]);
      check_frame(state.distance.frame);
      for (const Exit& exit : state.exits) require(exit.source >= 0 && exit.source < states() && exit.target >= 0 && exit.target < states());
    }
  }

  std::vector<Transform> frames_;
  int inputs_, initial_;
  std::vector<State> states_;
  std::vector<HalfSpace> tangents_;
};

// Guidance by a template: a few inputs move the command within the active constraints of the present state.
class TemplateGuidance {
 public:
  explicit TemplateGuidance(const Data& data)
      : template_(data), mapping_(data, data.has("mapping/states") ? "mapping/" : "template/"),
        has_own_mapping_(data.has("mapping/states")), period_(data.number("period")),
        max_tracking_error_(data.number("template/max_tracking_error")) {}

  int outputs() const { return 6; }
  int actions() const { return mapping_.inputs(); }
  int state() const { return state_; }
  double transition_distance() const { return template_.distance_to_go(state_, pose_to_transform(output_.data())); }

  // Undoes the first step of an episode.
  void rewind() { is_started_ = false; }

  // True if an active constraint or a limit of speed changed the last request.
  bool is_constrained() const { return is_constrained_; }

  // Moves the frame of an object, by its number in skill.json, to a pose (6,).
  void set_frame(int index, const double* pose) {
    template_.set_frame(index, pose);
    if (!has_own_mapping_ && index < mapping_.frames()) mapping_.set_frame(index, pose);
  }

  // Begins an episode at a measured pose (6,).
  void start(const double* pose) {
    const Transform X = pose_to_transform(pose);
    state_ = template_.state_at(X);
    transform_to_pose(template_.command(state_, X, X, period_), last_.data());
    std::copy(pose, pose + 6, measured_.begin());
    output_ = last_;
    is_started_ = false;
  }

  // Computes the command of the next control step for inputs (n,) and the measured pose (6,).
  Command step(const double* action, const double* pose) {
    if (is_started_) {
      state_ = template_.next_state(state_, pose_to_transform(output_.data()), period_);
      last_ = output_;
      std::copy(pose, pose + 6, measured_.begin());
    }
    is_started_ = true;
    const bool is_repeated = !follow(action);
    return {output_.data(), template_.violation(state_, pose_to_transform(output_.data())), is_repeated};
  }

 private:
  // Sets the output to the constrained request; returns false if the last command is repeated.
  bool follow(const double* action) {
    if (is_finite(action, mapping_.inputs()) && is_finite(measured_.data(), 6)) {
      const int state = has_own_mapping_ ? mapping_.initial_state() : state_;
      std::array<double, 6> requested;
      transform_to_pose(mapping_.request(state, action, pose_to_transform(last_.data()), period_), requested.data());
      std::array<double, 6> desired{};
      if (is_finite(requested.data(), 6)) {
        constrain(requested, desired);
        is_constrained_ = false;
        for (int i = 0; i < 6; ++i) is_constrained_ = is_constrained_ || !(std::abs(desired[i] - requested[i]) <= 1e-9);
        const Vec3 measured{measured_[0], measured_[1], measured_[2]};
        const double error = distance({last_[0], last_[1], last_[2]}, measured);
        const bool reduces_error = distance({desired[0], desired[1], desired[2]}, measured) < error - kRounding;
        const bool is_waiting = error > max_tracking_error_ && !reduces_error;
        if (!is_waiting && is_finite(desired.data(), 6)) {
          output_ = desired;
          return true;
        }
      }
    }
    output_ = last_;
    // Projecting a command that is already inside would move it by rounding errors at every step.
    if (template_.violation(state_, pose_to_transform(last_.data())) > 1e-9) {
      std::array<double, 6> inside;
      constrain(last_, inside);
      if (is_finite(inside.data(), 6)) output_ = inside;
    }
    return false;
  }

  void constrain(const std::array<double, 6>& requested, std::array<double, 6>& desired) {
    transform_to_pose(template_.command(state_, pose_to_transform(last_.data()), pose_to_transform(requested.data()), period_), desired.data());
  }

  static constexpr double kRounding = 1e-9;

  Template template_, mapping_;
  bool has_own_mapping_;
  double period_, max_tracking_error_;
  int state_ = 0;
  bool is_started_ = false, is_constrained_ = false;
  std::array<double, 6> last_{}, measured_{}, output_{};
};

}  // namespace guiderail
