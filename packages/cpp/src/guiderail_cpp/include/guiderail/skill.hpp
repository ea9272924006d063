// Skill: observation, policy and guidance in one object that computes the command of each control step.
#pragma once

#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "guiderail/data.hpp"
#include "guiderail/force.hpp"
#include "guiderail/policy.hpp"
#include "guiderail/primitive.hpp"
#include "guiderail/template.hpp"

namespace guiderail {

// The constructor allocates and throws std::exception if the data are damaged. Afterwards no function allocates or throws,
// and the time of a step is bounded.
//
//   Skill skill(Data("skill.safetensors"));
//   skill.start(pose);
//   for (;;) { std::copy_n(wrench, 6, skill.signal("wrench")); send(skill.step(pose).pose); }
class Skill {
 public:
  explicit Skill(const Data& data)
      : policy_(data), observation_(data), period_(data.number("period")), duration_(data.number("duration")),
        action_repeat_(data.whole("action_repeat")) {
    if (data.has("primitive/output_map")) primitive_.emplace(data);
    else template_.emplace(data);
    if (data.has("governor/stiffness")) governor_.emplace(data);
    if (data.has("phase_limit/limits")) phase_limit_.emplace(data);
    held_.resize(static_cast<std::size_t>(policy_.outputs()));
    desired_.resize(static_cast<std::size_t>(outputs()));
    time_ = observation_.signal("time"), phase_ = observation_.signal("phase");
    pose_size_ = observation_.size("pose"), desired_size_ = observation_.size("desired_pose");
    pose_ = observation_.signal("pose"), desired_pose_ = observation_.signal("desired_pose");
    wrench_ = observation_.size("wrench") == 6 ? observation_.signal("wrench") : nullptr;
    pressure_ = observation_.signal("center_of_pressure"), min_force_ = data.number("observation/min_force");
    contact_ = observation_.signal("mean_contact_point"), max_samples_ = data.number("observation/contact_samples");
    for (const char* name : {"center_of_pressure", "mean_contact_point"})
      if (observation_.signal(name) && observation_.size(name) != 2) throw std::runtime_error("a point of contact is two numbers");
    if (contact_ && outputs() < 2) throw std::runtime_error("a mean point of contact needs a position");
    state_ = observation_.signal("state"), distance_ = observation_.signal("transition_distance");
    if (policy_.inputs() != observation_.count()) throw std::runtime_error("the observation does not fit the policy");
    if (!(period_ > 0 && std::isfinite(period_) && std::isfinite(duration_) && action_repeat_ >= 1))
      throw std::runtime_error("the period, the duration or the repetition of actions of the skill is invalid");
    if (std::max(pose_size_, desired_size_) > outputs()) throw std::runtime_error("the observed pose does not fit the guidance");
    const int actions = primitive_ ? primitive_->actions() : template_->actions();
    if (actions != policy_.outputs()) throw std::runtime_error("the policy's action does not fit the guidance");
  }

  double period() const { return period_; }      // control period [s]
  double duration() const { return duration_; }  // duration of an episode [s]
  int outputs() const { return primitive_ ? primitive_->outputs() : template_->outputs(); }
  int actions() const { return policy_.outputs(); }
  const double* action() const { return held_.data(); }  // action of the present control step
  const double* desired() const { return desired_.data(); }  // last command (O,)
  bool is_constrained() const { return primitive_ ? primitive_->is_constrained() : template_->is_constrained(); }
  int state() const { return template_ ? template_->state() : 0; }
  bool is_over() const { return steps_ * period_ >= duration_; }
  const std::optional<Governor>& governor() const { return governor_; }
  const std::vector<std::string>& signals() const { return observation_.names(); }

  // Place of a signal that the policy observes, to be written before each step; nullptr if it does not observe it. The
  // signals time, phase, pose, desired_pose, state and transition_distance, and center_of_pressure and mean_contact_point if
  // the whole wrench is observed, are written by the skill itself.
  double* signal(const std::string& name) { return observation_.signal(name); }
  int signal_size(const std::string& name) const { return observation_.size(name); }

  // Moves the frame of an object of the template to a pose (6,).
  void set_frame(int index, const double* pose) {
    if (template_) template_->set_frame(index, pose);
  }

  // Begins an episode at a measured pose (O,).
  void start(const double* pose) {
    steps_ = 0, samples_ = mean_[0] = mean_[1] = 0.0;
    std::fill(held_.begin(), held_.end(), 0.0);
    if (phase_limit_) phase_limit_->start();
    if (primitive_) {
      primitive_->start(pose);
      keep(primitive_->step(held_.data(), pose));
      primitive_->rewind();
    } else {
      template_->start(pose);
      keep(template_->step(held_.data(), pose));
      template_->rewind();
    }
  }

  // Computes the command of the next control step for the measured pose (O,).
  Command step(const double* pose) {
    if (steps_ % action_repeat_ == 0) {
      const double time = steps_ * period_;
      if (time_) *time_ = std::min(time, duration_);
      if (phase_) *phase_ = -1.0 + 2.0 * std::min(time / duration_, 1.0);
      if (pose_) std::copy_n(pose, pose_size_, pose_);
      if (desired_pose_) std::copy_n(desired_.begin(), desired_size_, desired_pose_);
      if (pressure_ && wrench_) {
        const bool is_reliable = wrench_[2] >= min_force_;
        pressure_[0] = is_reliable ? -wrench_[4] / wrench_[2] : 0.0;
        pressure_[1] = is_reliable ? wrench_[3] / wrench_[2] : 0.0;
      }
      if (contact_ && wrench_)
        for (int i = 0; i < 2; ++i) contact_[i] = samples_ > 0.0 ? mean_[i] - pose[i] : 0.0;
      if (state_ && template_) *state_ = template_->state();
      if (distance_ && template_) *distance_ = template_->transition_distance();
      const double* action = policy_(observation_.values());
      std::copy_n(action, held_.size(), held_.begin());
    }
    if (contact_ && wrench_) remember(pose);
    return guide(held_.data(), pose);
  }

  // Computes the command for an action (A,) of another policy.
  Command guide(const double* action, const double* pose) {
    ++steps_;
    return keep(primitive_ ? primitive_->step(action, pose) : template_->step(action, pose));
  }

  // Limit (8,) of the wrench in the present state, at most `max_wrench`; nullptr if no state of the template has one.
  const double* max_wrench(const double* max_wrench) { return phase_limit_ ? phase_limit_->step(state(), max_wrench) : nullptr; }

 private:
  Command keep(const Command& command) {
    std::copy_n(command.pose, desired_.size(), desired_.begin());
    return command;
  }

  // Adds the point of contact to the mean, if force and pose are finite and the force is reliable.
  void remember(const double* pose) {
    const auto is_finite = [](double value) { return std::isfinite(value); };
    const bool is_usable = std::all_of(wrench_, wrench_ + 6, is_finite) && std::all_of(pose, pose + outputs(), is_finite);
    if (!is_usable || wrench_[2] < min_force_) return;
    samples_ = std::min(samples_ + 1.0, max_samples_);
    const double pressure[2] = {-wrench_[4] / wrench_[2], wrench_[3] / wrench_[2]};
    for (int i = 0; i < 2; ++i) mean_[i] += (pose[i] + pressure[i] - mean_[i]) / samples_;
  }

  Policy policy_;
  Observation observation_;
  double period_, duration_;
  int action_repeat_;
  std::optional<Primitive> primitive_;
  std::optional<TemplateGuidance> template_;
  std::optional<Governor> governor_;
  std::optional<PhaseWrenchLimit> phase_limit_;
  std::vector<double> held_, desired_;
  double *time_, *phase_, *pose_, *desired_pose_, *state_, *distance_, *wrench_, *pressure_, *contact_;
  double min_force_, max_samples_, samples_ = 0.0, mean_[2] = {0.0, 0.0};
  int pose_size_, desired_size_;
  long steps_ = 0;
};

}  // namespace guiderail
