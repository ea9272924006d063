// Replays recorded inputs through a skill or a single law, compares the results with those of Python, counts allocations
// and measures the time of a step.
//
//   replay DATA RECORDING [TOLERANCE]
//
// The exit status is 0 if every result is within the tolerance (1e-12 by default) and no step allocates memory.
#include <ctime>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <new>
#include <vector>

#include "guiderail/filters.hpp"
#include "guiderail/skill.hpp"

static long allocations = 0;

// Not inlined, because GCC would warn that memory of `new` is freed by `free`.
__attribute__((noinline)) void* operator new(std::size_t size) {
  ++allocations;
  if (void* memory = std::malloc(size ? size : 1)) return memory;
  throw std::bad_alloc();
}
__attribute__((noinline)) void operator delete(void* memory) noexcept { std::free(memory); }
__attribute__((noinline)) void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

#ifdef GUIDERAIL_COUNT_MALLOC  // the linker replaces calls of malloc by this function (--wrap=malloc)
extern "C" void* __real_malloc(std::size_t size);
extern "C" void* __wrap_malloc(std::size_t size) {
  ++allocations;
  return __real_malloc(size);
}
#endif

using namespace guiderail;

namespace {

// Processor time of this thread [µs]: other programs on the same core do not count.
double now() {
  timespec time{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return 1e6 * static_cast<double>(time.tv_sec) + 1e-3 * static_cast<double>(time.tv_nsec);
}

class Replay {
 public:
  Replay(const Data& record, double tolerance) : record_(record), tolerance_(tolerance) {}

  const double* row(const std::string& name, std::size_t t) const {
    const Tensor& tensor = record_.get("replay/" + name);
    return tensor.data() + t * (tensor.size() / std::max<std::size_t>(tensor.dim(0), 1));
  }

  void compare(const std::string& name, std::size_t t, const double* values) {
    const Tensor& tensor = record_.get("replay/" + name);
    const std::size_t width = tensor.size() / tensor.dim(0);
    for (std::size_t i = 0; i < width; ++i) compare(tensor[t * width + i], values[i]);
  }
  void compare(double expected, double value) {
    const bool is_equal = expected == value || (std::isnan(expected) && std::isnan(value));
    const double difference = is_equal ? 0.0 : std::abs(expected - value);
    if (!(difference <= worst_)) worst_ = difference;
  }

  // Calls `step` for each recorded step; it returns the time that the law took [µs].
  template <class Step>
  int run(Step step) {
    const std::size_t steps = record_.get("replay/reset").size();
    std::vector<double> times(steps);
    allocations_ = 0;
    for (std::size_t t = 0; t < steps; ++t) times[t] = step(t);
    const long counted = allocations_;
    std::sort(times.begin(), times.end());
    std::printf("%zu steps, %.0f %% with an active constraint or limit, largest difference %.3g, %ld allocations, p50 %.2f us, p99.9 %.2f us, max %.2f us\n", steps,
                100.0 * static_cast<double>(constrained_) / static_cast<double>(steps), worst_, counted,
                times[steps / 2], times[steps - 1 - steps / 1000], times.back());
    return worst_ <= tolerance_ && counted == 0 ? 0 : 1;
  }

  void count(bool is_constrained) { constrained_ += is_constrained; }

  template <class Law>
  double timed(Law law) {
    const long before = allocations;
    const double start = now();
    law();
    const double end = now();
    allocations_ += allocations - before;
    return end - start;
  }

 private:
  const Data& record_;
  double tolerance_, worst_ = 0;
  long allocations_ = 0, constrained_ = 0;
};

int replay_skill(const Data& data, const Data& record, Replay& replay) {
  Skill skill(data);
  const Tensor& reset = record.get("replay/reset");
  std::vector<double*> places;
  std::vector<int> sizes;
  for (const std::string& name : skill.signals()) places.push_back(skill.signal(name)), sizes.push_back(skill.signal_size(name));
  return replay.run([&](std::size_t t) {
    const double *signals = replay.row("signals", t), *pose = replay.row("pose", t);
    Command command{};
    const double time = replay.timed([&] {
      if (reset[t] != 0.0) skill.start(pose);
      for (std::size_t i = 0; i < places.size(); signals += sizes[i], ++i) std::copy_n(signals, sizes[i], places[i]);
      command = skill.step(pose);
    });
    replay.compare("action", t, skill.action());
    replay.compare("command", t, command.pose);
    replay.compare(record.get("replay/fallback")[t], command.fallback);
    replay.count(skill.is_constrained());
    return time;
  });
}

template <class Guidance>
int replay_guidance(const Data& data, const Data& record, Replay& replay) {
  Guidance guidance(data);
  const Tensor &reset = record.get("replay/reset"), &fallback = record.get("replay/fallback"), &violation = record.get("replay/violation");
  return replay.run([&](std::size_t t) {
    Command command{};
    const double *action = replay.row("action", t), *pose = replay.row("pose", t);
    const double time = replay.timed([&] {
      if (reset[t] != 0.0) guidance.start(pose);
      command = guidance.step(action, pose);
    });
    replay.compare("command", t, command.pose);
    replay.compare(fallback[t], command.fallback);
    replay.compare(violation[t], command.violation);
    replay.count(guidance.is_constrained());
    if (record.has("replay/state")) {
      if constexpr (std::is_same_v<Guidance, TemplateGuidance>) replay.compare(record.get("replay/state")[t], guidance.state());
    }
    return time;
  });
}

// True if two arrays of six numbers differ by more than rounding, or one is not finite.
bool differs(const double* first, const double* second) {
  for (int i = 0; i < 6; ++i)
    if (!(std::abs(first[i] - second[i]) <= 1e-9)) return true;
  return false;
}

int replay_governor(const Data& data, Replay& replay) {
  const Governor governor(data);
  return replay.run([&](std::size_t t) {
    double reference[6];
    const double *desired = replay.row("desired", t), *pose = replay.row("pose", t), *velocity = replay.row("velocity", t);
    const double* max_wrench = replay.row("max_wrench", t);
    const double time = replay.timed([&] { governor.apply(desired, pose, velocity, max_wrench, reference); });
    replay.compare("reference", t, reference);
    replay.count(differs(reference, desired));
    return time;
  });
}

int replay_wrench(const Data& data, Replay& replay) {
  const Governor governor(data);
  return replay.run([&](std::size_t t) {
    Vec6 spring, damping, wrench;
    std::copy_n(replay.row("spring", t), 6, spring.begin());
    std::copy_n(replay.row("damper", t), 6, damping.begin());
    const double *velocity = replay.row("velocity", t), *inertia = replay.row("inertia", t);
    const double time = replay.timed([&] { wrench = bounded_wrench(spring, damping, velocity, {inertia[0], inertia[1]}, governor.bound()); });
    replay.compare("wrench", t, wrench.data());
    Vec6 free;
    for (int i = 0; i < 6; ++i) free[i] = spring[i] - damping[i];
    replay.count(differs(wrench.data(), free.data()));
    return time;
  });
}

int replay_phase_limit(const Data& data, const Data& record, Replay& replay) {
  PhaseWrenchLimit limit(data);
  const Tensor& reset = record.get("replay/reset");
  return replay.run([&](std::size_t t) {
    const double *bound = nullptr, *state = replay.row("state", t), *max_wrench = replay.row("max_wrench", t);
    const double time = replay.timed([&] {
      if (reset[t] != 0.0) limit.start();
      bound = limit.step(static_cast<int>(*state), max_wrench);
    });
    replay.compare("bound", t, bound);
    bool is_lower = false;
    for (int j = 0; j < 8; ++j) is_lower = is_lower || bound[j] < max_wrench[j];
    replay.count(is_lower);
    return time;
  });
}

int replay_rate_limiter(const Data& data, const Data& record, Replay& replay) {
  RateLimiter limiter(data.number("period"), data.number("speed"), data.number("angular_speed"));
  const Tensor& reset = record.get("replay/reset");
  return replay.run([&](std::size_t t) {
    const double *desired = replay.row("desired", t), *pose = replay.row("pose", t), *limited = nullptr;
    const bool is_controlled = *replay.row("controlled", t) > 0.0;
    const double time = replay.timed([&] {
      if (reset[t] != 0.0) limiter.start(pose);
      limited = limiter.step(desired, pose, is_controlled);
    });
    replay.compare("limited", t, limited);
    replay.count(differs(limited, desired));
    return time;
  });
}

int replay_watchdog(const Data& data, const Data& record, Replay& replay) {
  Watchdog watchdog(data.number("period"), data.number("timeout"), 6);
  const Tensor& reset = record.get("replay/reset");
  return replay.run([&](std::size_t t) {
    const double *desired = replay.row("desired", t), *pose = replay.row("pose", t), *followed = nullptr;
    const double now = *replay.row("time", t), stamp = *replay.row("stamp", t);
    const bool is_controlled = *replay.row("controlled", t) > 0.0;
    const double time = replay.timed([&] {
      if (reset[t] != 0.0) watchdog.start(now, pose);
      followed = watchdog.step(now, desired, stamp, pose, is_controlled);
    });
    replay.compare("followed", t, followed);
    replay.compare(*replay.row("timed_out", t), watchdog.has_timed_out());
    replay.count(watchdog.has_timed_out());
    return time;
  });
}

int replay_policy(const Data& data, Replay& replay) {
  Policy policy(data);
  return replay.run([&](std::size_t t) {
    const double *action = nullptr, *observation = replay.row("observation", t);
    const double time = replay.timed([&] { action = policy(observation); });
    replay.compare("action", t, action);
    return time;
  });
}

int replay_all(const Data& data, const Data& record, double tolerance) {
  Replay replay(record, tolerance);
  const auto has = [&](const char* name) { return record.has(std::string("replay/") + name); };
  if (has("signals")) return replay_skill(data, record, replay);
  if (has("command")) {
    return data.has("primitive/output_map") ? replay_guidance<Primitive>(data, record, replay)
                                            : replay_guidance<TemplateGuidance>(data, record, replay);
  }
  if (has("reference")) return replay_governor(data, replay);
  if (has("wrench")) return replay_wrench(data, replay);
  if (has("bound")) return replay_phase_limit(data, record, replay);
  if (has("limited")) return replay_rate_limiter(data, record, replay);
  if (has("followed")) return replay_watchdog(data, record, replay);
  return replay_policy(data, replay);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "usage: replay DATA RECORDING [TOLERANCE]\n");
    return 2;
  }
  try {
    return replay_all(Data(argv[1]), Data(argv[2]), argc > 3 ? std::atof(argv[3]) : 1e-12);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 2;
  }
}
