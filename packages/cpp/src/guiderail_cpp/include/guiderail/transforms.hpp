// Rotations and poses [x y z Rz Ry Rx], by the formulas of guiderail.models.common.transforms in their order of operations.
//
// Products are fused multiply-adds in the order of NumPy's matrix products on processors with this instruction, so that
// long recordings differ from Python's by few rounding errors.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace guiderail {

using Vec3 = std::array<double, 3>;
constexpr double kEpsilon = std::numeric_limits<double>::epsilon();

// Matrix (3, 3), row-major.
struct Mat3 {
  std::array<double, 9> m{1, 0, 0, 0, 1, 0, 0, 0, 1};
  double operator()(int i, int j) const { return m[3 * i + j]; }
  double& operator()(int i, int j) { return m[3 * i + j]; }
};

inline double dot3(double a0, double b0, double a1, double b1, double a2, double b2) {
  return std::fma(a2, b2, std::fma(a1, b1, a0 * b0));
}
inline double dot(const Vec3& a, const Vec3& b) { return dot3(a[0], b[0], a[1], b[1], a[2], b[2]); }
inline Vec3 operator+(const Vec3& a, const Vec3& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }
inline Vec3 operator-(const Vec3& a, const Vec3& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
inline Vec3 operator*(double s, const Vec3& a) { return {s * a[0], s * a[1], s * a[2]}; }
inline Vec3 operator/(const Vec3& a, double s) { return {a[0] / s, a[1] / s, a[2] / s}; }
inline double norm(const Vec3& a) { return std::sqrt(dot(a, a)); }

// Length of a vector of two or three numbers, rounded as by math.hypot and math.dist of Python (CPython's vector_norm).
inline double hypotenuse(double x, double y, double z = 0, int n = 2) {
  const double numbers[3] = {std::abs(x), std::abs(y), std::abs(z)};
  double largest = 0;
  for (int i = 0; i < n; ++i) {
    if (std::isnan(numbers[i])) return numbers[i];
    largest = std::max(largest, numbers[i]);
  }
  if (largest == 0 || std::isinf(largest)) return largest;
  int exponent = 0;
  std::frexp(largest, &exponent);
  if (exponent < -1000) return std::hypot(x, y, z);
  const double scale = std::ldexp(1.0, -exponent);
  double sum = 1, rest = 0, lost = 0;
  const auto add = [&](double a, double b) {
    const double product = a * b, total = sum + product;
    rest += std::fma(a, b, -product);
    lost += (sum - total) + product;
    sum = total;
  };
  for (int i = 0; i < n; ++i) add(numbers[i] * scale, numbers[i] * scale);
  const double h = std::sqrt(sum - 1.0 + (rest + lost));
  add(-h, h);
  return (h + (sum - 1.0 + (rest + lost)) / (2.0 * h)) / scale;
}
inline double distance(const Vec3& a, const Vec3& b) { return hypotenuse(a[0] - b[0], a[1] - b[1], a[2] - b[2], 3); }

inline Mat3 operator*(const Mat3& A, const Mat3& B) {
  Mat3 C;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) C(i, j) = dot3(A(i, 0), B(0, j), A(i, 1), B(1, j), A(i, 2), B(2, j));
  return C;
}
inline Mat3 transposed(const Mat3& A) { return {{A(0, 0), A(1, 0), A(2, 0), A(0, 1), A(1, 1), A(2, 1), A(0, 2), A(1, 2), A(2, 2)}}; }
inline Vec3 operator*(const Mat3& A, const Vec3& x) {
  Vec3 y;
  for (int i = 0; i < 3; ++i) y[i] = dot3(A(i, 0), x[0], A(i, 1), x[1], A(i, 2), x[2]);
  return y;
}
// Aᵀ x of a matrix in column-major order, whose rows NumPy multiplies in another order.
inline Vec3 transposed_product(const Mat3& A, const Vec3& x) {
  Vec3 y;
  for (int i = 0; i < 3; ++i) y[i] = dot3(A(1, i), x[1], A(0, i), x[0], A(2, i), x[2]);
  return y;
}

struct Transform {
  Mat3 R;
  Vec3 p{0, 0, 0};
};

inline Mat3 rpy_rotation(double roll, double pitch, double yaw) {
  const double s0 = std::sin(roll), c0 = std::cos(roll), s1 = std::sin(pitch), c1 = std::cos(pitch);
  const double s2 = std::sin(yaw), c2 = std::cos(yaw), c2s1 = c2 * s1, s2s1 = s2 * s1;
  return {{c2 * c1, c2s1 * s0 - s2 * c0, c2s1 * c0 + s2 * s0, s2 * c1, s2s1 * s0 + c2 * c0, s2s1 * c0 - c2 * s0, -s1, c1 * s0, c1 * c0}};
}

// Unit quaternion (w, x, y, z) of a rotation, with w ≥ 0.
inline std::array<double, 4> quaternion(const Mat3& R) {
  const double a = R.m[0], b = R.m[1], c = R.m[2], d = R.m[3], e = R.m[4], f = R.m[5], g = R.m[6], h = R.m[7], i = R.m[8];
  const double trace = a + (e + i);
  double w, x, y, z;
  if (trace >= a && trace >= e && trace >= i) w = 1 + trace, x = h - f, y = c - g, z = d - b;
  else if (a >= e && a >= i) w = h - f, x = 1 - (trace - 2 * a), y = b + d, z = c + g;
  else if (e >= i) w = c - g, x = b + d, y = 1 - (trace - 2 * e), z = f + h;
  else w = d - b, x = c + g, y = f + h, z = 1 - (trace - 2 * i);
  const double scale = (w < 0 ? -1.0 : 1.0) / std::sqrt((x * x + z * z) + (y * y + w * w));
  return {w * scale, x * scale, y * scale, z * scale};
}

inline double within_half_turn(double angle) {
  constexpr double pi = 3.141592653589793;
  return angle > pi ? angle - 2 * pi : angle < -pi ? angle + 2 * pi : angle;
}

// Roll, pitch and yaw [rad].
inline Vec3 rpy_angles(const Mat3& M) {
  const auto [w, x, y, z] = quaternion(M);
  const double M00 = M(0, 0), M10 = M(1, 0), M20 = M(2, 0), M21 = M(2, 1), M22 = M(2, 2);
  const double cos_pitch = std::sqrt((M22 * M22 + M21 * M21 + M10 * M10 + M00 * M00) / 2);
  const auto angle = [](double sine, double cosine) {
    return std::abs(sine) <= kEpsilon && std::abs(cosine) <= kEpsilon ? 0.0 : std::atan2(sine, cosine);
  };
  const double half_sum = angle(x + z, w - y), half_difference = angle(z - x, w + y);
  return {within_half_turn(half_sum - half_difference), std::atan2(-M20, cos_pitch), within_half_turn(half_sum + half_difference)};
}

inline Mat3 axis_angle_rotation(const Vec3& axis, double angle) {
  double x = axis[0], y = axis[1], z = axis[2];
  const double size = std::sqrt((x * x + y * y) + z * z);
  x = x / size, y = y / size, z = z / size;
  const double sine = std::sin(angle), cosine = std::cos(angle);
  const double sx = sine * x, sy = sine * y, sz = sine * z, versine = 1 - cosine;
  const double vx = versine * x, vy = versine * y, vz = versine * z, xy = vx * y, xz = vx * z, yz = vy * z;
  return {{vx * x + cosine, xy - sz, xz + sy, xy + sz, vy * y + cosine, yz - sx, xz - sy, yz + sx, vz * z + cosine}};
}

struct AxisAngle {
  Vec3 axis;
  double angle;
};

// Unit axis and angle [rad] in [0, π]; the axis is x if the angle is zero.
inline AxisAngle axis_angle(const Mat3& M) {
  const double trace = M(0, 0) + (M(1, 1) + M(2, 2));
  Vec3 v;
  double w;
  if (trace > 0) {
    const double root = std::sqrt(trace + 1), scale = 0.5 / root;
    w = 0.5 * root;
    v = {(M(2, 1) - M(1, 2)) * scale, (M(0, 2) - M(2, 0)) * scale, (M(1, 0) - M(0, 1)) * scale};
  } else {
    int i = M(1, 1) > M(0, 0) ? 1 : 0;
    if (M(2, 2) > M(i, i)) i = 2;
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    const double root = std::sqrt(M(i, i) - M(j, j) - M(k, k) + 1), scale = 0.5 / root;
    v[i] = 0.5 * root;
    w = (M(k, j) - M(j, k)) * scale;
    v[j] = (M(j, i) + M(i, j)) * scale, v[k] = (M(k, i) + M(i, k)) * scale;
  }
  double size = std::sqrt((v[0] * v[0] + v[1] * v[1]) + v[2] * v[2]);
  if (size < kEpsilon) size = std::hypot(v[0], v[1], v[2]);
  if (size == 0) return {{1, 0, 0}, 0};
  return {v / (w < 0 ? -size : size), 2 * std::atan2(size, std::abs(w))};
}

inline Transform pose_to_transform(const double* pose) {
  return {rpy_rotation(pose[5], pose[4], pose[3]), {pose[0], pose[1], pose[2]}};
}

inline void transform_to_pose(const Transform& X, double* pose) {
  const Vec3 angles = rpy_angles(X.R);
  for (int i = 0; i < 3; ++i) pose[i] = X.p[i], pose[3 + i] = angles[2 - i];
}

// Angle [rad] in [−π, π) of the same orientation, as Python's remainder has the sign of the divisor.
inline double wrapped(double angle) {
  constexpr double pi = 3.141592653589793, turn = 2.0 * pi;
  double rest = std::fmod(angle + pi, turn);
  if (rest != 0 && rest < 0) rest += turn;
  return rest - pi;
}

// `first` minus `second`, two poses (6,), each angle in [−π, π).
inline std::array<double, 6> pose_difference(const double* first, const double* second) {
  std::array<double, 6> d;
  for (int i = 0; i < 6; ++i) d[i] = i < 3 ? first[i] - second[i] : wrapped(first[i] - second[i]);
  return d;
}

// Angle [rad] between two rotations, accurate for small angles too.
inline double angle_between(const Mat3& A, const Mat3& B) {
  double square = 0;
  for (int i = 0; i < 9; ++i) {
    const double d = A.m[i] - B.m[i];
    square = std::fma(d, d, square);
  }
  return 2.0 * std::asin(std::min(1.0, std::sqrt(square) / std::sqrt(8.0)));
}


// Pose at a fraction of the motion from A to B along a straight line and about a constant axis.
inline Transform between(const Transform& A, const Transform& B, double fraction) {
  if (fraction == 1.0) return B;
  const Vec3 p = A.p + fraction * (B.p - A.p);
  const AxisAngle turn = axis_angle(transposed(A.R) * B.R);
  return {A.R * axis_angle_rotation(turn.axis, fraction * turn.angle), p};
}

}  // namespace guiderail
