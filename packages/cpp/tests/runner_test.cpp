// Runs an exported skill with wrong and missing measurements: targets stay finite, slow and inside the force bound, and
// nothing is allocated or thrown.
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <limits>
#include <random>
#include <vector>

#include "guiderail/runner.hpp"

// The replay counts allocations, and is compiled with this program, because a program takes seconds to compile.
#define main replay
#include "test/replay.cpp"
#undef main

#define CHECK(condition) \
  if (!(condition)) return std::fprintf(stderr, "line %d: %s\n", __LINE__, #condition), 1

using namespace guiderail;
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kPeriod = 0.001;

struct Measured {
  double pose[7], wrench[6] = {0, 0, 0, 0, 0, 0};
};

// Pose of the skill as a measured pose in a base that is the frame of the skill.
static Measured measured_at(const double* pose) {
  Measured measured;
  const Transform X = pose_to_transform(pose);
  const auto q = quaternion(X.R);
  for (int i = 0; i < 3; ++i) measured.pose[i] = X.p[i], measured.pose[3 + i] = q[1 + i];
  measured.pose[6] = q[0];
  return measured;
}

static double distance(const double* a, const double* b) {
  double squared = 0;
  for (int i = 0; i < 3; ++i) squared += (a[i] - b[i]) * (a[i] - b[i]);
  return std::sqrt(squared);
}

static bool throws(const Data& data, const RunnerSettings& settings) {
  try {
    Runner runner(data, settings);
    return false;
  } catch (const std::exception&) {
    return true;
  }
}

static int test_settings(const Data& data) {
  RunnerSettings settings;
  CHECK(!throws(data, settings));
  settings.task_frame[6] = 0.5;
  CHECK(throws(data, settings));
  for (double wrong : {0.0, -1.0, kNaN, 1.0}) {
    settings = {};
    settings.update_period = wrong;
    CHECK(throws(data, settings));
  }
  for (double wrong : {0.0, -1.0, kNaN}) {
    settings = {};
    settings.max_speed = wrong;
    CHECK(throws(data, settings));
  }
  return 0;
}

// A tool that does not move: the target stays within the speed limit, and within the force bound of the tool.
static int test_limits(const Data& data, const double* start) {
  for (bool bounds_force : {false, true}) {
    RunnerSettings settings;
    settings.bounds_force = bounds_force;
    Runner runner(data, settings);
    const Measured measured = measured_at(start);
    CHECK(runner.start(measured.pose));
    double last[7];
    std::copy_n(measured.pose, 7, last);
    const Tensor &K = data.get("governor/stiffness"), &bound = data.get("governor/bound");
    const long before = allocations;
    for (int i = 0; i < 2000; ++i) {
      const double* target = runner.update(kPeriod, measured.pose, measured.wrench, 0.0);
      if (!bounds_force) CHECK(distance(target, last) <= settings.max_speed * kPeriod + 1e-9);
      if (bounds_force)
        for (int axis = 0; axis < 3; ++axis) CHECK(std::abs(K[axis] * (target[axis] - measured.pose[axis])) <= bound[axis] + 1e-6);
      std::copy_n(target, 7, last);
    }
    CHECK(allocations == before);
  }
  return 0;
}

// While measurements are missing the skill waits: it needs as many updates with measurements as without the gap.
static int test_gap(const Data& data, const double* start) {
  int used[2];
  for (int has_gap = 0; has_gap < 2; ++has_gap) {
    Runner runner(data, {});
    const Measured measured = measured_at(start);
    CHECK(runner.start(measured.pose));
    for (used[has_gap] = 0; runner.state() != RunnerState::kFinished; ++used[has_gap]) {
      CHECK(used[has_gap] < 100000);
      runner.update(kPeriod, measured.pose, measured.wrench, 0.0);
      if (has_gap && used[1] == 300) {
        double held[7];
        std::copy_n(runner.update(kPeriod, measured.pose, measured.wrench, 1.0), 7, held);
        for (int i = 0; i < 500; ++i) CHECK(distance(runner.update(kPeriod, measured.pose, measured.wrench, 1.0), held) == 0.0);
        CHECK(runner.state() == RunnerState::kStale);
        runner.update(0.0, measured.pose, measured.wrench, 0.0);
        CHECK(runner.state() == RunnerState::kRunning);
      }
    }
  }
  CHECK(used[0] == used[1]);
  return 0;
}

// A target beside a measured pose that the tool cannot have reached would move the tool: it is held.
static int test_jump(const Data& data, const double* start) {
  Runner runner(data, {});
  const Measured measured = measured_at(start);
  CHECK(runner.start(measured.pose));
  double held[7];
  for (int i = 0; i < 100; ++i) std::copy_n(runner.update(kPeriod, measured.pose, measured.wrench, 0.0), 7, held);
  Measured moved = measured, turned = measured;
  moved.pose[0] += 0.5;
  turned.pose[3] = measured.pose[6], turned.pose[6] = -measured.pose[3];  // half a turn about x
  turned.pose[4] = -measured.pose[5], turned.pose[5] = measured.pose[4];
  for (const Measured& wrong : {moved, turned}) {
    for (int i = 0; i < 500; ++i) CHECK(distance(runner.update(kPeriod, wrong.pose, wrong.wrench, 0.0), held) == 0.0);
    CHECK(runner.state() == RunnerState::kStale);
    CHECK(distance(runner.update(kPeriod, measured.pose, measured.wrench, 0.0), held) < 1e-3);
    CHECK(runner.state() == RunnerState::kRunning);
    std::copy_n(runner.update(kPeriod, measured.pose, measured.wrench, 0.0), 7, held);
  }
  return 0;
}

// Data whose arrays do not fit each other are refused when they are read.
static int test_damaged(const char* path) {
  std::ifstream file(path, std::ios::binary);
  const std::string content((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  const std::string damaged_path = std::string(path) + ".damaged";
  std::uint64_t header = 0;
  std::memcpy(&header, content.data(), 8);
  std::mt19937 random(0);
  int refused = 0, accepted = 0;
  for (int i = 0; i < 60; ++i) {
    std::string damaged = content;
    for (int changes = 1 + static_cast<int>(random() % 3); changes > 0; --changes) {
      char& symbol = damaged[8 + random() % (header + (i % 2 ? 0 : 4000))];
      symbol = symbol >= '0' && symbol <= '9' ? static_cast<char>('0' + random() % 10) : static_cast<char>(random());
    }
    if (i % 10 == 0) damaged.resize(random() % damaged.size());
    std::ofstream(damaged_path, std::ios::binary).write(damaged.data(), static_cast<std::streamsize>(damaged.size()));
    try {
      Skill skill{Data(damaged_path)};
      const std::vector<double> pose(static_cast<std::size_t>(skill.outputs()), 0.0);
      skill.start(pose.data());
      for (int step = 0; step < 20; ++step) skill.step(pose.data());
      ++accepted;
    } catch (const std::exception&) {
      ++refused;
    }
  }
  std::remove(damaged_path.c_str());
  CHECK(refused > 15 && accepted > 0);
  return 0;
}

// Random measurements, many of them impossible.
static int test_garbage(const Data& data, const double* start) {
  std::mt19937 random(0);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  const double wrong[] = {kNaN, std::numeric_limits<double>::infinity(), -1e300, 1e300, 0.0, 1e-300};
  Runner runner(data, {});
  Skill skill(data);
  const Measured good = measured_at(start);
  CHECK(runner.start(good.pose));
  skill.start(start);
  const long before = allocations;
  for (int i = 0; i < 6000; ++i) {
    Measured measured = good;
    double pose[6], period = kPeriod, age = 0.0;
    std::copy_n(start, 6, pose);
    for (double& value : measured.wrench) value = 10 * uniform(random);
    const auto damage = [&](double& value) {
      if (uniform(random) > 0.8) value = wrong[random() % 6];
    };
    for (double& value : measured.pose) damage(value);
    for (double& value : measured.wrench) damage(value);
    for (double& value : pose) damage(value);
    damage(period), damage(age);
    if (random() % 500 == 0) runner.start(measured.pose), skill.start(pose);
    const double* target = runner.update(period, measured.pose, measured.wrench, age);
    CHECK(is_finite(target, 7));
    if (double* signal = skill.signal("wrench")) std::copy_n(measured.wrench, skill.signal_size("wrench"), signal);
    skill.step(pose);
  }
  CHECK(allocations == before);
  CHECK(runner.start(good.pose));  // and it works again
  runner.update(kPeriod, good.pose, good.wrench, 0.0);
  CHECK(runner.state() == RunnerState::kRunning);
  double zero[7] = {0.1, 0.1, 0.1, 0, 0, 0, 0};  // a quaternion of zeros
  CHECK(!runner.start(zero));
  return 0;
}

// runner_test DATA RECORDING, runner_test DATA to damage only the data, or runner_test replay DATA RECORDING TOLERANCE.
int main(int argc, char** argv) {
  if (std::strcmp(argv[1], "replay") == 0) return replay(argc - 1, argv + 1);
  if (argc == 2) return test_damaged(argv[1]);
  const Data data(argv[1]), recording(argv[2]);
  const double* start = recording.get("replay/pose").data();
  return test_settings(data) || test_limits(data, start) || test_gap(data, start) || test_jump(data, start) || test_garbage(data, start) ||
         test_damaged(argv[1]);
}
