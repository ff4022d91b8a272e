#include "core/scene/gltf_accessor.h"

#include <tiny_gltf.h>

#include <algorithm>
#include <cstring>

namespace farpoint {

namespace {

double ReadComponent(const unsigned char* at, int type, bool normalized) {
  const auto load = [at](auto value) {
    std::memcpy(&value, at, sizeof(value));
    return value;
  };
  // Normalised integers as in the glTF specification, section 3.11.
  switch (type) {
    case TINYGLTF_COMPONENT_TYPE_BYTE: {
      const double v = load(int8_t{});
      return normalized ? std::max(v / 127.0, -1.0) : v;
    }
    case TINYGLTF_COMPONENT_TYPE_UNSIGNED_BYTE: {
      const double v = load(uint8_t{});
      return normalized ? v / 255.0 : v;
    }
    case TINYGLTF_COMPONENT_TYPE_SHORT: {
      const double v = load(int16_t{});
      return normalized ? std::max(v / 32767.0, -1.0) : v;
    }
    case TINYGLTF_COMPONENT_TYPE_UNSIGNED_SHORT: {
      const double v = load(uint16_t{});
      return normalized ? v / 65535.0 : v;
    }
    case TINYGLTF_COMPONENT_TYPE_UNSIGNED_INT:
      return load(uint32_t{});
    default:
      return static_cast<double>(load(float{}));
  }
}

const unsigned char* DataOf(const tinygltf::Model& model, int view_index, size_t offset) {
  const auto& view = model.bufferViews[static_cast<size_t>(view_index)];
  return model.buffers[static_cast<size_t>(view.buffer)].data.data() + view.byteOffset + offset;
}

}  // namespace

AccessorReader::AccessorReader(const tinygltf::Model& model, int index) {
  const tinygltf::Accessor& accessor = model.accessors[static_cast<size_t>(index)];
  count_ = accessor.count;
  component_type_ = accessor.componentType;
  component_size_ =
      tinygltf::GetComponentSizeInBytes(static_cast<uint32_t>(accessor.componentType));
  components_ = tinygltf::GetNumComponentsInType(static_cast<uint32_t>(accessor.type));
  normalized_ = accessor.normalized;
  if (accessor.bufferView >= 0) {
    const auto& view = model.bufferViews[static_cast<size_t>(accessor.bufferView)];
    base_ = DataOf(model, accessor.bufferView, accessor.byteOffset);
    stride_ =
        view.byteStride == 0 ? static_cast<size_t>(component_size_ * components_) : view.byteStride;
  }
  if (!accessor.sparse.isSparse) return;
  sparse_values_ = DataOf(model, accessor.sparse.values.bufferView,
                          static_cast<size_t>(accessor.sparse.values.byteOffset));
  const unsigned char* at = DataOf(model, accessor.sparse.indices.bufferView,
                                   static_cast<size_t>(accessor.sparse.indices.byteOffset));
  const int type = accessor.sparse.indices.componentType;
  const int size = tinygltf::GetComponentSizeInBytes(static_cast<uint32_t>(type));
  sparse_indices_.resize(static_cast<size_t>(accessor.sparse.count));
  for (auto& value : sparse_indices_) {
    value = static_cast<uint32_t>(ReadComponent(at, type, false));
    at += size;
  }
}

bool AccessorReader::SparseIndicesAreValid() const {
  for (size_t i = 0; i < sparse_indices_.size(); ++i) {
    if (sparse_indices_[i] >= count_) return false;
    if (i > 0 && sparse_indices_[i] <= sparse_indices_[i - 1]) return false;
  }
  return true;
}

double AccessorReader::Get(size_t element, int component) const {
  const unsigned char* at = base_ == nullptr ? nullptr : base_ + element * stride_;
  if (!sparse_indices_.empty()) {
    const auto it = std::lower_bound(sparse_indices_.begin(), sparse_indices_.end(), element);
    if (it != sparse_indices_.end() && *it == element) {
      at = sparse_values_ + static_cast<size_t>(it - sparse_indices_.begin()) *
                                static_cast<size_t>(component_size_ * components_);
    }
  }
  if (at == nullptr) return 0;
  return ReadComponent(at + component * component_size_, component_type_, normalized_);
}

}  // namespace farpoint
