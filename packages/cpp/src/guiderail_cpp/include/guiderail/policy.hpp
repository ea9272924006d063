// Policy: a feed-forward network with weights of single precision, evaluated in double precision, and its observation.
#pragma once

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "guiderail/data.hpp"

namespace guiderail {

// Network from an observation (n,) to an action (A,).
class Policy {
 public:
  explicit Policy(const Data& data)
      : low_(data.get("policy/low")), high_(data.get("policy/high")), activation_(data.text("activation")),
        clips_(data.text("squash") == "clip") {
    std::size_t widest = 0;
    for (int i = 0; data.has("policy/weight_" + std::to_string(i)); ++i) {
      const Tensor& weight = data.get("policy/weight_" + std::to_string(i));
      const Tensor& bias = data.get("policy/bias_" + std::to_string(i));
      layers_.push_back({std::vector<float>(weight.values.begin(), weight.values.end()), bias.values,
                         static_cast<int>(weight.dim(0)), static_cast<int>(weight.dim(1))});
      const std::size_t into = i == 0 ? weight.dim(1) : layers_[layers_.size() - 2].bias.size();
      if (weight.shape != std::vector<std::size_t>{bias.size(), into} || bias.shape.size() != 1 || weight.size() == 0)
        throw std::runtime_error("the layers of the policy do not fit each other");
      widest = std::max({widest, weight.dim(0), weight.dim(1)});
    }
    if (layers_.empty()) throw std::runtime_error("the data of the skill have no policy");
    if (low_.size() != layers_.back().bias.size() || high_.size() != low_.size())
      throw std::runtime_error("the limits of the action do not fit the policy");
    first_.resize(widest), second_.resize(widest), action_.resize(low_.size());
  }

  int inputs() const { return layers_.front().inputs; }
  int outputs() const { return static_cast<int>(low_.size()); }

  // Computes the action for an observation, which is rounded to single precision; valid until the next call.
  const double* operator()(const double* observation) {
    for (int i = 0; i < inputs(); ++i) first_[i] = static_cast<float>(observation[i]);
    for (std::size_t l = 0; l < layers_.size(); ++l) {
      const Layer& layer = layers_[l];
      for (int o = 0; o < layer.outputs; ++o) second_[o] = product(layer, o) + layer.bias[o];
      if (l + 1 < layers_.size()) activate(layer.outputs);
      first_.swap(second_);
    }
    for (int a = 0; a < outputs(); ++a) {
      const double value = first_[a];
      action_[a] = clips_ ? (std::isnan(value) ? value : std::min(std::max(value, low_[a]), high_[a]))
                          : low_[a] + 0.5 * (std::tanh(value) + 1.0) * (high_[a] - low_[a]);
    }
    return action_.data();
  }

 private:
  struct Layer {
    std::vector<float> weight;
    std::vector<double> bias;
    int outputs, inputs;
  };

  double product(const Layer& layer, int row) const {
    const float* w = layer.weight.data() + static_cast<std::size_t>(row) * layer.inputs;
    double s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    int i = 0;
    for (; i + 3 < layer.inputs; i += 4) {
      s0 += w[i] * first_[i];
      s1 += w[i + 1] * first_[i + 1];
      s2 += w[i + 2] * first_[i + 2];
      s3 += w[i + 3] * first_[i + 3];
    }
    for (; i < layer.inputs; ++i) s0 += w[i] * first_[i];
    return (s0 + s1) + (s2 + s3);
  }

  void activate(int n) {
    if (activation_ == "normalized_relu") {
      double mean = 0, square = 0;
      for (int i = 0; i < n; ++i) mean += second_[i];
      mean /= n;
      for (int i = 0; i < n; ++i) second_[i] -= mean, square += second_[i] * second_[i];
      const double deviation = std::sqrt(square / n + static_cast<double>(1e-5f));
      for (int i = 0; i < n; ++i) second_[i] /= deviation;
    }
    const bool is_tanh = activation_ == "tanh";
    for (int i = 0; i < n; ++i) second_[i] = is_tanh ? std::tanh(second_[i]) : second_[i] > 0 || std::isnan(second_[i]) ? second_[i] : 0.0;
  }

  const Tensor low_, high_;
  const std::string activation_;
  const bool clips_;
  std::vector<Layer> layers_;
  std::vector<double> first_, second_, action_;
};

// Entries of an observation, clip((signal − center) / scale). Signals are known by their names in skill.json.
class Observation {
 public:
  explicit Observation(const Data& data)
      : entries_(data.get("observation/entries")), sizes_(data.get("observation/sizes")), values_(entries_.dim(0)) {
    if (entries_.size() != 5 * values_.size()) throw std::runtime_error("an entry of the observation has five numbers");
    std::size_t at = 0;
    for (std::size_t i = 0; i < sizes_.size(); ++i) {
      if (!(sizes_[i] >= 1 && sizes_[i] <= 1e6)) throw std::runtime_error("a signal of the observation has at least one number");
      names_.push_back(data.text("signal_" + std::to_string(i)));
      starts_.push_back(at);
      at += static_cast<std::size_t>(sizes_[i]);
    }
    signals_.assign(std::max<std::size_t>(at, 1), 0.0);
    for (std::size_t i = 0; i < values_.size(); ++i) {
      if (!(entries_[5 * i] >= 0 && entries_[5 * i] <= 1e6 && entries_[5 * i + 1] >= 0 && entries_[5 * i + 1] <= 1e6))
        throw std::runtime_error("an entry of the observation is outside of its signal");
      const auto signal = static_cast<std::size_t>(entries_[5 * i]);
      indices_.push_back(starts_.at(signal) + static_cast<std::size_t>(entries_[5 * i + 1]));
      if (indices_.back() >= at) throw std::runtime_error("an entry of the observation is outside of its signal");
    }
  }

  int count() const { return static_cast<int>(values_.size()); }  // number of entries
  const std::vector<std::string>& names() const { return names_; }

  // Place of a signal's numbers, to be written before each step; nullptr if the policy does not observe the signal.
  double* signal(const std::string& name) {
    for (std::size_t i = 0; i < names_.size(); ++i)
      if (names_[i] == name) return signals_.data() + starts_[i];
    return nullptr;
  }

  // Number of numbers of a signal; 0 if the policy does not observe it.
  int size(const std::string& name) const {
    for (std::size_t i = 0; i < names_.size(); ++i)
      if (names_[i] == name) return static_cast<int>(sizes_[i]);
    return 0;
  }

  const double* values() {
    for (std::size_t i = 0; i < values_.size(); ++i) {
      const double* entry = entries_.data() + 5 * i;
      const double clip = entry[4];
      const double value = signals_[indices_[i]] * (1.0 / entry[3]) + -entry[2] / entry[3];
      values_[i] = std::isnan(value) ? value : std::min(std::max(value, -clip), clip);
    }
    return values_.data();
  }

 private:
  const Tensor entries_;  // for each entry: signal, index, center, scale, clip
  const Tensor sizes_;
  std::vector<std::string> names_;
  std::vector<std::size_t> starts_, indices_;
  std::vector<double> signals_, values_;
};

}  // namespace guiderail
