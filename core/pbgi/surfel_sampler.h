// Blue-noise (Poisson-disc) sampling of all surfaces (paper §4: "Poisson Disk sampling").
//
// Each object is sampled on its own, in its own frame (core/pbgi/surfel_shape.h): where its surfels
// lie on its triangles is a function of its shape, the holes of its alpha mask, the spacing and the
// seed. So it keeps them, bit by bit, when it is moved or turned and when others change, and who
// has sampled it once need not do so again.
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "core/base/executor.h"
#include "core/base/hash.h"
#include "core/pbgi/surfel.h"
#include "core/pbgi/surfel_shape.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

// The least distance between surfels that gives about `count` of them (within 2 % on large
// surfaces). Rounded, in units of the root of the largest object's area, to 7 bits: a scene whose
// area changes a little keeps its surfels, and so does one that is modelled in another unit. 0 if
// there is no area or no count.
float SurfelSpacingM(const SurfaceSize& size, uint64_t count);

// The spacing when the user names no count: one surfel for each square of edge diagonal/500, but no
// more than `most`, between `least` and 4,000,000, rounded to 3 bits in the same unit. Depends on
// the scene only, never on the camera.
float DefaultSurfelSpacingM(const SurfaceSize& size, float diagonal_m, uint64_t least,
                            uint64_t most);

// Where the surfels of one object lie on it. All of one length. Neighbours in the order are
// neighbours in space: cubes of 16 spacings along a Morton curve.
struct ObjectSurfels {
  BulkVector<uint32_t> triangle;  // of the object
  BulkVector<Vec2f> barycentric;  // weights of vertices 1 and 2
  BulkVector<float> area;         // units² of the shape; sums to its area without its holes

  size_t size() const { return triangle.size(); }
  size_t size_bytes() const {
    return sizeof(ObjectSurfels) + size() * (sizeof(uint32_t) + sizeof(Vec2f) + sizeof(float));
  }
};

// Samples one object. Candidates, eight for each surfel and at least eight, are spread evenly by
// area, left out in holes of alpha masks, and thinned by dart throwing: cubes of 16 spacings in
// eight phases, such that those of one phase do not touch and can be done side by side; within a
// cube in a random order. Then each candidate gives its area to the nearest surfel, so that areas
// follow the local density. Surfels compete only with those of the same side of a thin sheet. The
// result does not depend on the number of threads.
class ObjectSampler {
 public:
  // `shape` and `prepared` must outlive the sampler; `object` is that of the shape. Cheap unless
  // the object has an alpha mask, whose holes are looked up.
  ObjectSampler(const ObjectShape& shape, const PreparedScene& prepared, size_t object,
                float spacing_m, uint64_t seed, Executor& executor);
  ~ObjectSampler();
  ObjectSampler(const ObjectSampler&) = delete;
  ObjectSampler& operator=(const ObjectSampler&) = delete;

  // Names the result of Sample(): equal keys, equal surfels.
  const Digest& key() const { return key_; }
  ObjectSurfels Sample();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
  Digest key_;
};

// The surfels of all objects (one for each object of `prepared`, in order) in the world.
SurfelCloud PlaceSurfels(const PreparedScene& prepared, std::span<const ObjectShape> shapes,
                         std::span<const std::shared_ptr<const ObjectSurfels>> surfels,
                         Executor& executor);

// All of the above: about `count` surfels on the whole scene, none on repeated objects. `prepared`
// was made by Prepare from `scene`.
SurfelCloud SampleSurfels(const Scene& scene, const PreparedScene& prepared, uint64_t count,
                          uint64_t seed, Executor& executor);

}  // namespace farpoint
