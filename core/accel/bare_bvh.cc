#include "core/accel/bare_bvh.h"

#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

#include <atomic>
#include <new>
#include <string>
#include <vector>

namespace farpoint {

namespace {

constexpr unsigned kBranching = 8;

struct Node {
  RTCBounds bounds[kBranching];
  void* child[kBranching];
};
struct Leaf {
  unsigned count;
  unsigned primitive[kBranching];
};

void* CreateNode(RTCThreadLocalAllocator allocator, unsigned, void* made) {
  static_cast<std::atomic<size_t>*>(made)->fetch_add(1, std::memory_order_relaxed);
  return new (rtcThreadLocalAlloc(allocator, sizeof(Node), 16)) Node;
}
void SetChildren(void* node, void** children, unsigned count, void*) {
  for (unsigned i = 0; i < count; ++i) static_cast<Node*>(node)->child[i] = children[i];
}
void SetBounds(void* node, const RTCBounds** bounds, unsigned count, void*) {
  for (unsigned i = 0; i < count; ++i) static_cast<Node*>(node)->bounds[i] = *bounds[i];
}
void* CreateLeaf(RTCThreadLocalAllocator allocator, const RTCBuildPrimitive* primitives,
                 size_t count, void* made) {
  static_cast<std::atomic<size_t>*>(made)->fetch_add(1, std::memory_order_relaxed);
  auto* leaf = new (rtcThreadLocalAlloc(allocator, sizeof(Leaf), 16)) Leaf;
  leaf->count = static_cast<unsigned>(count);
  for (size_t i = 0; i < count; ++i) leaf->primitive[i] = primitives[i].primID;
  return leaf;
}

}  // namespace

struct BareBvh::Impl {
  RTCDevice device = nullptr;
  std::vector<RTCBuildPrimitive> primitives;
  ~Impl() {
    if (device) rtcReleaseDevice(device);
  }
};

BareBvh::BareBvh(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
BareBvh::~BareBvh() = default;

absl::StatusOr<std::unique_ptr<BareBvh>> BareBvh::Create(unsigned threads) {
  auto impl = std::make_unique<Impl>();
  impl->device = rtcNewDevice(("isa=avx2,threads=" + std::to_string(threads)).c_str());
  if (!impl->device) {
    return absl::UnavailableError("Embree gave no device (rtcNewDevice error " +
                                  std::to_string(static_cast<int>(rtcGetDeviceError(nullptr))) +
                                  ")");
  }
  return std::unique_ptr<BareBvh>(new BareBvh(std::move(impl)));
}

absl::StatusOr<size_t> BareBvh::Build(std::span<const Box3f> boxes, Quality quality) {
  // A build reorders them.
  impl_->primitives.resize(boxes.size());
  for (size_t i = 0; i < boxes.size(); ++i) {
    const Box3f& b = boxes[i];
    impl_->primitives[i] = {b.min.x, b.min.y, b.min.z, 0,
                            b.max.x, b.max.y, b.max.z, static_cast<unsigned>(i)};
  }
  std::atomic<size_t> made{0};
  const RTCBVH bvh = rtcNewBVH(impl_->device);
  RTCBuildArguments arguments = rtcDefaultBuildArguments();
  arguments.buildQuality =
      quality == Quality::kLow ? RTC_BUILD_QUALITY_LOW : RTC_BUILD_QUALITY_MEDIUM;
  arguments.maxBranchingFactor = kBranching;
  arguments.minLeafSize = 1;
  arguments.maxLeafSize = kBranching;
  arguments.bvh = bvh;
  arguments.primitives = impl_->primitives.data();
  arguments.primitiveCount = impl_->primitives.size();
  arguments.primitiveArrayCapacity = impl_->primitives.size();
  arguments.createNode = CreateNode;
  arguments.setNodeChildren = SetChildren;
  arguments.setNodeBounds = SetBounds;
  arguments.createLeaf = CreateLeaf;
  arguments.userPtr = &made;
  const void* const root = rtcBuildBVH(&arguments);
  rtcReleaseBVH(bvh);
  const RTCError error = rtcGetDeviceError(impl_->device);
  if (error != RTC_ERROR_NONE || (root == nullptr && !boxes.empty())) {
    return absl::UnavailableError("rtcBuildBVH failed with Embree's error " +
                                  std::to_string(static_cast<int>(error)));
  }
  return made.load();
}

}  // namespace farpoint
