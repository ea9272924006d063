// Data of an exported skill: named arrays in a safetensors file. Reading it allocates and may throw; nothing later does.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

namespace guiderail {

// Array of doubles, row-major. Arrays of single precision are converted, which is exact.
struct Tensor {
  std::vector<std::size_t> shape;
  std::vector<double> values;

  std::size_t size() const { return values.size(); }
  std::size_t dim(std::size_t axis) const { return axis < shape.size() ? shape[axis] : 1; }
  const double* data() const { return values.data(); }
  double operator[](std::size_t index) const { return values[index]; }
};

// Content of a safetensors file with arrays of type F64 or F32, and text in its metadata.
class Data {
 public:
  // Reads a file; throws std::runtime_error if it is missing or damaged.
  explicit Data(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error(path + " cannot be read: name the file skill.safetensors of an exported skill");
    file.seekg(0, std::ios::end);
    const std::streamoff bytes = file.tellg();
    if (bytes < 0) fail(path);
    buffer_.resize(static_cast<std::size_t>(bytes));
    file.seekg(0);
    if (!file.read(buffer_.data(), bytes)) fail(path);
    std::uint64_t length = 0;
    if (buffer_.size() >= 8) std::memcpy(&length, buffer_.data(), 8);
    if (buffer_.size() < 8 || length > buffer_.size() - 8) fail(path);
    header_ = std::string(buffer_.data() + 8, length);
    start_ = 8 + static_cast<std::size_t>(length);
    parse_header(path);
    buffer_.clear();
    buffer_.shrink_to_fit();
  }

  bool has(const std::string& name) const { return tensors_.count(name) > 0; }

  const Tensor& get(const std::string& name) const {
    const auto found = tensors_.find(name);
    if (found == tensors_.end()) throw std::runtime_error("the data of the skill lack the array " + name);
    return found->second;
  }

  // Array of a shape; throws std::runtime_error if it is missing or has another one.
  const Tensor& get(const std::string& name, const std::vector<std::size_t>& shape) const {
    const Tensor& tensor = get(name);
    if (tensor.shape != shape) throw std::runtime_error("the array " + name + " of the skill has another shape: export the skill again");
    return tensor;
  }

  double number(const std::string& name) const { return get(name).values.at(0); }
  int whole(const std::string& name) const { return static_cast<int>(number(name)); }

  // Text of the metadata; empty if there is none of this name.
  std::string text(const std::string& name) const {
    const auto found = texts_.find(name);
    return found == texts_.end() ? std::string() : found->second;
  }

  const std::map<std::string, Tensor>& tensors() const { return tensors_; }

 private:
  [[noreturn]] static void fail(const std::string& path) {
    throw std::runtime_error(path + " is damaged: export the skill again");
  }

  void skip() {
    while (at_ < header_.size() && std::strchr(" \n\t\r,:", header_[at_])) ++at_;
  }

  std::string read_string(const std::string& path) {
    skip();
    if (at_ >= header_.size() || header_[at_] != '"') fail(path);
    std::string text;
    for (++at_; at_ < header_.size() && header_[at_] != '"'; ++at_) {
      if (header_[at_] == '\\' && at_ + 1 < header_.size()) ++at_;
      text += header_[at_];
    }
    ++at_;
    return text;
  }

  std::vector<std::size_t> read_list(const std::string& path) {
    skip();
    if (at_ >= header_.size() || header_[at_] != '[') fail(path);
    std::vector<std::size_t> values;
    for (++at_; at_ < header_.size() && header_[at_] != ']'; skip()) {
      std::size_t used = 0;
      values.push_back(std::stoull(header_.substr(at_, 24), &used));
      at_ += used;
    }
    ++at_;
    return values;
  }

  void expect(char symbol, const std::string& path) {
    skip();
    if (at_ >= header_.size() || header_[at_] != symbol) fail(path);
    ++at_;
  }

  bool ends() {
    skip();
    return at_ >= header_.size() || header_[at_] == '}';
  }

  void parse_header(const std::string& path) {
    expect('{', path);
    while (!ends()) {
      const std::string name = read_string(path);
      expect('{', path);
      std::string type;
      std::vector<std::size_t> shape, offsets;
      while (!ends()) {
        const std::string key = read_string(path);
        if (name == "__metadata__") texts_[key] = read_string(path);
        else if (key == "dtype") type = read_string(path);
        else if (key == "shape") shape = read_list(path);
        else offsets = read_list(path);
      }
      expect('}', path);
      if (name != "__metadata__") add(name, type, shape, offsets, path);
    }
  }

  void add(const std::string& name, const std::string& type, const std::vector<std::size_t>& shape,
           const std::vector<std::size_t>& offsets, const std::string& path) {
    const std::size_t width = type == "F64" ? 8 : type == "F32" ? 4 : 0;
    std::size_t count = 1;
    for (std::size_t size : shape) {
      if (size > buffer_.size()) fail(path);  // before the product can overflow
      count *= size;
      if (count > buffer_.size()) fail(path);
    }
    const bool is_inside = width > 0 && offsets.size() == 2 && offsets[1] >= offsets[0] &&
                           offsets[1] - offsets[0] == count * width && offsets[1] <= buffer_.size() - start_;
    if (!is_inside) fail(path);
    Tensor tensor{shape, std::vector<double>(count)};
    const char* from = buffer_.data() + start_ + offsets[0];
    for (std::size_t i = 0; i < count; ++i) {
      float single = 0;
      if (width == 8) std::memcpy(&tensor.values[i], from + 8 * i, 8);
      else std::memcpy(&single, from + 4 * i, 4), tensor.values[i] = single;
    }
    tensors_.emplace(name, std::move(tensor));
  }

  std::vector<char> buffer_;
  std::string header_;
  std::size_t start_ = 0, at_ = 0;
  std::map<std::string, Tensor> tensors_;
  std::map<std::string, std::string> texts_;
};

// Dot product with four independent sums, which a compiler vectorizes.
inline double dot(const double* a, const double* b, int n) {
  double s0 = 0, s1 = 0, s2 = 0, s3 = 0;
  int i = 0;
  for (; i + 3 < n; i += 4) {
    s0 += a[i] * b[i];
    s1 += a[i + 1] * b[i + 1];
    s2 += a[i + 2] * b[i + 2];
    s3 += a[i + 3] * b[i + 3];
  }
  for (; i < n; ++i) s0 += a[i] * b[i];
  return (s0 + s1) + (s2 + s3);
}

inline bool is_finite(const double* values, int n) {
  for (int i = 0; i < n; ++i)
    if (!std::isfinite(values[i])) return false;
  return true;
}

// Result of a control step.
struct Command {
  const double* pose;  // commanded pose (O,), valid until the next step
  double violation;    // largest violation of a constraint by the command; negative if all constraints are slack
  bool fallback;       // true if a safe pose is commanded instead of the requested one
};

}  // namespace guiderail
