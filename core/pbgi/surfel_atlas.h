// What a ray that hits a triangle brings back, without shading the point afresh: the radiance of
// the surfel nearest to it. Triangles are cut into texels about as large as a surfel; a texel is
// resolved when it is first read, by a search in a hash grid, and then costs one or two cache
// lines.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "core/accel/ray_accel.h"
#include "core/math/vec.h"
#include "core/pbgi/point_tree.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

// The surfel nearest to a point, by a hash grid over the tree's surfels. Immutable; thread-safe.
class SurfelGrid {
 public:
  // `tree` must outlive the grid.
  explicit SurfelGrid(const PointTree& tree);

  // The radiance [W/(m² sr)] on the front (`n`, unit) or back of a surface at `p`: that of the
  // nearest surfel within 1.5 spacings whose plane is within 60° of n's and passes within a
  // hundredth of a spacing of p, of those that look along n if there are any, else of those that
  // look against it. None if there is none, and where its side is not visible: something stands on
  // it, and p is not under that. What decides must not be the radiance itself: that is noisy, and a
  // choice by it is a bias.
  // `where`: none, or gets the surfel's position.
  std::optional<Rgb> Find(const Vec3f& p, const Vec3f& n, bool front, Vec3f* where = nullptr) const;

  struct Side {
    uint32_t slot;
    bool front;
  };
  // The nearest surfel by Find's rules, whatever it reflects, whose side there is visible: what
  // something stands on is not. `where` as for Find.
  std::optional<Side> FindVisible(const Vec3f& p, const Vec3f& n, bool front,
                                  Vec3f* where = nullptr) const;

  // sqrt(mean area of a surfel); 0 for an empty tree.
  float spacing_m() const { return spacing_m_; }

 private:
  // What a search looks at, side by side.
  struct Entry {
    Vec3f position;
    uint32_t slot;
    Vec3f normal;
  };
  struct Cell {
    uint64_t key = kEmpty;
    uint32_t first = 0, count = 0;
  };
  struct Nearest;
  static constexpr uint64_t kEmpty = ~uint64_t{0};
  const Cell* FindCell(uint64_t key) const;
  // Calls `see` with each entry of the cells about p that Find's rules admit: the squared distance,
  // and 0 if it looks along n, else 1.
  template <typename See>
  void ForEachNear(const Vec3f& p, const Vec3f& n, const See& see) const;

  const PointTree& tree_;
  float spacing_m_ = 0, inverse_cell_ = 0;
  Vec3f low_;
  std::vector<Entry> entries_;  // cell by cell
  std::vector<Cell> cells_;     // open addressing, a power of two
};

// Thread-safe: a texel's value is a function of scene and tree, so it does not matter who resolves
// it, and when.
class SurfelAtlas {
 public:
  // The tree must be of the accelerated scene; both must outlive the atlas. 16 bytes a texel, of
  // memory that is touched when it is read; at most kMaxTexels (then texels are larger than
  // surfels).
  // With `radiance`, an atlas of the same scene and tree that outlives this one and lends its grid:
  // of the irradiance after further bounces, W/m², in place of the radiance. The tree must have it.
  SurfelAtlas(const RayAccel& accel, const PointTree& tree, const SurfelAtlas* radiance = nullptr);

  // The point (b1, b2) of `triangle`, on the side of its front (winding) or back.
  struct Point {
    uint32_t triangle;
    float b1, b2;
    bool front;
  };
  // The radiance at a point, as SurfelGrid::Find gives it at the texel's centre, rounded to 16 bits
  // below the largest channel. None, too, where something stands on the texel, or between it and
  // the surfel: the light on its other side is another. Of irradiance that of the surfel of
  // FindVisible; where no surfel has it for the texel, that which kTexelRays rays from its centre
  // bring.
  std::optional<Rgb> Radiance(const Point& point) const;
  // The same of up to kTogether points, whose fetches from memory overlap: bit i is set where there
  // is one at points[i].
  uint64_t Radiances(std::span<const Point> points, std::span<Rgb> radiance) const;

  static constexpr size_t kTogether = 64;

  float spacing_m() const { return grid_->spacing_m(); }

  static constexpr uint32_t kTexelRays = 32;
  static constexpr uint64_t kMaxTexels = uint64_t{1} << 28;

 private:
  struct FreeDeleter {
    void operator()(void* p) const;
  };
  struct Patch {
    uint64_t first : 40, side : 24;  // side² texels from `first`
  };
  struct Texel {
    uint32_t column, row;
    uint64_t word;  // index into words_
  };
  Texel TexelOf(const Point& point, const Patch& patch) const;
  uint64_t Resolve(const Point& point, const Texel& texel, uint32_t side) const;
  bool CutOff(const Vec3f& from, const Vec3f& to) const;
  // The irradiance at p on the side of `out`, read where rays end.
  Rgb Gathered(const Point& point, const Vec3f& p, const Vec3f& out, uint64_t key) const;
  // The word, resolved if need be.
  uint64_t Value(const Point& point, const Texel& texel, uint32_t side) const;

  const RayAccel& accel_;
  const PreparedScene& scene_;
  const PointTree& tree_;
  const SurfelAtlas* const radiance_;
  const std::shared_ptr<const SurfelGrid> grid_;
  std::vector<Patch> patches_;  // by triangle
  // Two words a texel, front and back: 0: not resolved yet; see the .cc.
  std::unique_ptr<uint64_t[], FreeDeleter> words_;
};

}  // namespace farpoint
