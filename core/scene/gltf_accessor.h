// Reads the elements of a glTF accessor whose ranges CheckGltf has checked: any component type,
// normalised, strided, sparse. For core/scene's glTF files only.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/math/vec.h"

namespace tinygltf {
class Model;
}

namespace farpoint {

// Random access; views into the model, which must outlive it.
class AccessorReader {
 public:
  AccessorReader(const tinygltf::Model& model, int index);

  size_t count() const { return count_; }
  // Indices of sparse values must ascend and lie inside. To be asked before the elements are.
  bool SparseIndicesAreValid() const;
  // Normalised integers in [-1, 1] or [0, 1]; 0 where the accessor has no data. `element` <
  // count(); `component` < that of its type.
  double Get(size_t element, int component) const;
  Vec3d Get3d(size_t element) const { return {Get(element, 0), Get(element, 1), Get(element, 2)}; }
  Vec3f Get3(size_t element) const { return Vec3f(Get3d(element)); }
  Vec2f Get2(size_t element) const {
    return {static_cast<float>(Get(element, 0)), static_cast<float>(Get(element, 1))};
  }

 private:
  size_t count_;
  int component_type_, component_size_, components_;
  bool normalized_;
  const unsigned char* base_ = nullptr;
  size_t stride_ = 0;
  const unsigned char* sparse_values_ = nullptr;
  std::vector<uint32_t> sparse_indices_;
};

}  // namespace farpoint
