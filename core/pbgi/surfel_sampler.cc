#include "core/pbgi/surfel_sampler.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <cmath>
#include <limits>

#include "core/math/sampling.h"
#include "core/pbgi/key_sort.h"

namespace farpoint {

namespace {

constexpr int kCandidatesPerSurfel = 8;
// Distance between surfels over sqrt(area / count): with eight candidates each, dart throwing at
// this distance keeps about `count` of them (measured: within 2 % on planes).
constexpr double kSpacingFactor = 0.759;
// Surfels compete only with those of the same side of a thin sheet.
constexpr float kSameSurfaceCosine = 0.5f;

// A cell is one spacing wide, a cube kCubeCells cells.
constexpr int kCubeBits = 4;
constexpr int kCubeCells = 1 << kCubeBits;
constexpr int kGridSide = kCubeCells + 2;  // with one layer of cells of the neighbours around it
constexpr int kCubeCoordinateBits = 21;
constexpr uint64_t kCubeCoordinateMask = (uint64_t{1} << kCubeCoordinateBits) - 1;
constexpr uint32_t kNone = ~0u;
constexpr size_t kTrianglesPerPiece = 1024;
constexpr size_t kSurfelsPerPiece = size_t{1} << 14;
constexpr uint32_t kSamplerVersion = 1;

// Rounds to `bits` bits of mantissa.
double RoundMantissa(double x, int bits) {
  if (!(x > 0)) return 0;
  const uint64_t half = uint64_t{1} << (51 - bits);
  const uint64_t mask = ~((uint64_t{1} << (52 - bits)) - 1);
  return std::bit_cast<double>((std::bit_cast<uint64_t>(x) + half) & mask);
}

// Bits 0, 3, 6, … of the result are those of x.
uint64_t SpreadBits(uint64_t x) {
  x &= kCubeCoordinateMask;
  x = (x | x << 32) & 0x001f00000000ffffull;
  x = (x | x << 16) & 0x001f0000ff0000ffull;
  x = (x | x << 8) & 0x100f00f00f00f00full;
  x = (x | x << 4) & 0x10c30c30c30c30c3ull;
  x = (x | x << 2) & 0x1249249249249249ull;
  return x;
}
uint64_t CompactBits(uint64_t x) {
  x &= 0x1249249249249249ull;
  x = (x | x >> 2) & 0x10c30c30c30c30c3ull;
  x = (x | x >> 4) & 0x100f00f00f00f00full;
  x = (x | x >> 8) & 0x001f0000ff0000ffull;
  x = (x | x >> 16) & 0x001f00000000ffffull;
  x = (x | x >> 32) & kCubeCoordinateMask;
  return x;
}

// Cell coordinates. Those of cubes count modulo 2^21: cubes so far apart share a place in the
// tables, but never a distance.
struct Cell {
  int64_t x, y, z;

  // Morton code of the cube; its lowest three bits tell the cube's phase.
  uint64_t Cube() const {
    return SpreadBits(static_cast<uint64_t>(x >> kCubeBits)) |
           SpreadBits(static_cast<uint64_t>(y >> kCubeBits)) << 1 |
           SpreadBits(static_cast<uint64_t>(z >> kCubeBits)) << 2;
  }
};
constexpr unsigned kPhases = 8;

uint64_t NeighbourCube(uint64_t cube, int dx, int dy, int dz) {
  return SpreadBits(CompactBits(cube) + static_cast<uint64_t>(dx)) |
         SpreadBits(CompactBits(cube >> 1) + static_cast<uint64_t>(dy)) << 1 |
         SpreadBits(CompactBits(cube >> 2) + static_cast<uint64_t>(dz)) << 2;
}

// Space in cells, counted from the corner of the shape's box.
struct Lattice {
  Vec3f origin;
  float inverse_cell;

  // Position in cells; clamped to what fits int64_t with room, whatever the shape.
  Vec3f InCells(const Vec3f& p) const {
    const Vec3f c = (p - origin) * inverse_cell;
    return Max(Min(c, Vec3f(0x1p50f)), Vec3f(-0x1p50f));
  }
  static Cell CellOf(const Vec3f& in_cells) {
    return {static_cast<int64_t>(std::floor(in_cells.x)),
            static_cast<int64_t>(std::floor(in_cells.y)),
            static_cast<int64_t>(std::floor(in_cells.z))};
  }
};

// A point of a cube's grid.
struct GridPlace {
  int x, y, z;    // its cell
  Vec3f in_cell;  // where within it, in cells
};

struct Accepted {
  Vec3f position;
  uint32_t triangle;
  Vec2f barycentric;
  uint32_t share;  // candidates that are nearest to it
};

// The rows of cells around one, nearest first: if the middle holds a neighbour, nobody looks on.
constexpr std::array<std::array<int8_t, 2>, 9> kRows = {
    {{0, 0}, {0, -1}, {0, 1}, {-1, 0}, {1, 0}, {-1, -1}, {-1, 1}, {1, -1}, {1, 1}}};

// The surfels in and around one cube.
class CubeGrid {
 public:
  // Cells are `cell` wide.
  void Clear(float cell) {
    rows_.fill(0);
    samples_.clear();
    cell2_ = cell * cell;
  }
  // x, y, z in [0, kGridSide).
  void Insert(int x, int y, int z, const Vec3f& p, const Vec3f& n, uint32_t* share) {
    const uint32_t bit = 1u << x;
    uint32_t& row = rows_[static_cast<size_t>(z * kGridSide + y)];
    uint32_t& head = heads_[static_cast<size_t>((z * kGridSide + y) * kGridSide + x)];
    samples_.push_back({p, n, (row & bit) != 0 ? head : kNone, share});
    row |= bit;
    head = static_cast<uint32_t>(samples_.size() - 1);
  }
  // Whether a surfel of the same side lies within less than a cell's width of p at `place`, whose
  // coordinates are in [1, kGridSide - 1).
  bool AnyWithinOneCell(const GridPlace& place, const Vec3f& p, const Vec3f& n) const {
    const float distance2 = cell2_;
    return ForNear(place, distance2, [&](const Sample& s, float&) {
      return Length2(s.position - p) < distance2 && Dot(s.normal, n) > kSameSurfaceCosine;
    });
  }
  // The share of the nearest surfel of the same side, if there is one within a cell's width; null
  // or any that is farther away if not.
  uint32_t* Nearest(const GridPlace& place, const Vec3f& p, const Vec3f& n) const {
    uint32_t* share = nullptr;
    float nearest2 = std::numeric_limits<float>::infinity();
    ForNear(place, cell2_, [&](const Sample& s, float& reach2) {
      const float d2 = Length2(s.position - p);
      if (d2 < nearest2 && Dot(s.normal, n) > kSameSurfaceCosine) {
        nearest2 = d2;
        reach2 = std::min(reach2, d2);
        share = s.share;
      }
      return false;
    });
    return share;
  }

 private:
  struct Sample {
    Vec3f position, normal;
    uint32_t next;
    uint32_t* share;
  };

  // Calls visit(sample, reach2) for those in the 27 cells around, but for cells that are farther
  // away than sqrt(reach2), which visit may lower; until it returns true.
  template <typename Visit>
  bool ForNear(const GridPlace& place, float reach2, Visit&& visit) const {
    // Squared distances to the layers of cells before (0), at (1) and behind (2) the place's own,
    // rounded down far enough.
    const float scale = cell2_ * 0.9999f;
    const auto layers = [scale](float f) {
      return std::array<float, 3>{f * f * scale, 0.0f, (1.0f - f) * (1.0f - f) * scale};
    };
    const auto lx = layers(place.in_cell.x), ly = layers(place.in_cell.y),
               lz = layers(place.in_cell.z);
    for (const auto& [dz, dy] : kRows) {
      const float row2 = ly[static_cast<size_t>(dy + 1)] + lz[static_cast<size_t>(dz + 1)];
      if (row2 > reach2) continue;
      const int row = (place.z + dz) * kGridSide + place.y + dy;
      uint32_t cells = (rows_[static_cast<size_t>(row)] >> (place.x - 1)) & 7u;
      for (; cells != 0; cells &= cells - 1) {
        const int dx = std::countr_zero(cells);
        if (row2 + lx[static_cast<size_t>(dx)] > reach2) continue;
        for (uint32_t i = heads_[static_cast<size_t>(row * kGridSide + place.x - 1 + dx)];
             i != kNone; i = samples_[i].next) {
          if (visit(samples_[i], reach2)) return true;
        }
      }
    }
    return false;
  }

  std::array<uint32_t, kGridSide * kGridSide> rows_;  // which cells hold anything
  std::array<uint32_t, kGridSide * kGridSide * kGridSide> heads_;
  std::vector<Sample> samples_;
  float cell2_ = 0;
};

}  // namespace

// A part of a triangle with a few candidates.
struct ObjectSampler::Leaf {
  static constexpr uint32_t kMaxCandidates = 32;
  std::array<Vec2f, 3> corner;  // barycentric
  uint32_t triangle;
  uint32_t kept;  // a bit for each candidate that lies in no hole
  uint64_t seed;
};

struct ObjectSampler::Impl {
  const ObjectShape& shape;
  const PreparedScene& prepared;
  const PreparedObject& object;
  Executor& executor;
  float spacing = 0;        // units
  uint64_t seed = 0;        // of this shape
  uint64_t candidates = 0;  // drawn, those in holes included
  Lattice lattice{};

  struct Piece {
    std::vector<Leaf> leaves;
    std::vector<KeyedIndex> visits;  // cube, leaf: each once
  };
  std::vector<Leaf> leaves;
  std::vector<KeyedIndex> visits;

  Impl(const ObjectShape& s, const PreparedScene& p, size_t o, Executor& e)
      : shape(s), prepared(p), object(p.objects()[o]), executor(e) {}

  Vec3f PointOn(uint32_t t, const Vec2f& b) const {
    const auto& v = shape.triangles[t];
    const Vec3f& a = shape.vertices[v[0]];
    return a + (shape.vertices[v[1]] - a) * b.x + (shape.vertices[v[2]] - a) * b.y;
  }
  Vec3f NormalOf(uint32_t t) const {
    const auto& v = shape.triangles[t];
    const Vec3d a(shape.vertices[v[0]]);
    return Vec3f(NormalizeOr(
        Cross(Vec3d(shape.vertices[v[1]]) - a, Vec3d(shape.vertices[v[2]]) - a), Vec3d(0, 1, 0)));
  }

  // Calls visit(k, barycentric, position) for the kept candidates of a leaf: a Kronecker sequence
  // of the plastic number (Roberts 2018, "The unreasonable effectiveness of quasirandom
  // sequences"), started at random and folded onto the triangle.
  template <typename Visit>
  void ForCandidates(const Leaf& leaf, Visit&& visit) const {
    const Vec2f b0 = leaf.corner[0];
    const Vec2f d1{leaf.corner[1].x - b0.x, leaf.corner[1].y - b0.y};
    const Vec2f d2{leaf.corner[2].x - b0.x, leaf.corner[2].y - b0.y};
    const auto& t = shape.triangles[leaf.triangle];
    const Vec3f a = shape.vertices[t[0]];
    const Vec3f e1 = shape.vertices[t[1]] - a, e2 = shape.vertices[t[2]] - a;
    for (uint32_t bits = leaf.kept; bits != 0; bits &= bits - 1) {
      const auto k = static_cast<uint32_t>(std::countr_zero(bits));
      uint32_t u = static_cast<uint32_t>(leaf.seed >> 32) + k * 0xc13fa9a9u;
      uint32_t v = static_cast<uint32_t>(leaf.seed) + k * 0x91e10da5u;
      if (u > ~v) {
        u = ~u;
        v = ~v;
      }
      const float fu = ToUnitFloat(u), fv = ToUnitFloat(v);
      const Vec2f b{b0.x + d1.x * fu + d2.x * fv, b0.y + d1.y * fu + d2.y * fv};
      visit(k, b, a + e1 * b.x + e2 * b.y);
    }
  }

  // The candidates of one triangle, cut into leaves by halving the longest edge.
  void SplitTriangle(uint32_t triangle, uint32_t count, bool masked, float alpha_cutoff,
                     Piece& out) const {
    struct Part {
      std::array<Vec2f, 3> corner;
      uint32_t count;
      uint64_t seed;
    };
    std::vector<Part> todo = {{{Vec2f{0, 0}, {1, 0}, {0, 1}}, count, HashKey(seed, triangle)}};
    while (!todo.empty()) {
      const Part part = todo.back();
      todo.pop_back();
      if (part.count == 0) continue;
      if (part.count > Leaf::kMaxCandidates) {
        std::array<Vec3f, 3> p;
        for (size_t i = 0; i < 3; ++i) p[i] = PointOn(triangle, part.corner[i]);
        size_t longest = 0;
        float longest2 = -1;
        for (size_t i = 0; i < 3; ++i) {
          const float l2 = Length2(p[(i + 1) % 3] - p[i]);
          if (l2 > longest2) {
            longest2 = l2;
            longest = i;
          }
        }
        const Vec2f a = part.corner[longest], b = part.corner[(longest + 1) % 3];
        const Vec2f c = part.corner[(longest + 2) % 3];
        const Vec2f m{(a.x + b.x) * 0.5f, (a.y + b.y) * 0.5f};
        const uint64_t next = Mix64(part.seed);
        // An odd candidate goes to either half.
        const uint32_t first = part.count / 2 + (part.count & 1u & static_cast<uint32_t>(next));
        todo.push_back({{m, b, c}, part.count - first, Mix64(next ^ 0x55)});
        todo.push_back({{a, m, c}, first, next});
        continue;
      }
      Leaf leaf{part.corner, triangle, ~0u >> (32 - part.count), Mix64(part.seed ^ 0xaa)};
      if (masked) {
        uint32_t kept = 0;
        const auto t = static_cast<uint32_t>(object.first_triangle + triangle);
        ForCandidates(leaf, [&](uint32_t k, const Vec2f& b, const Vec3f&) {
          if (prepared.Alpha(t, b.x, b.y) >= alpha_cutoff) kept |= 1u << k;
        });
        leaf.kept = kept;
        if (kept == 0) continue;
      }
      const auto index = static_cast<uint32_t>(out.leaves.size());
      const size_t first_visit = out.visits.size();
      ForCandidates(leaf, [&](uint32_t, const Vec2f&, const Vec3f& p) {
        const uint64_t cube = Lattice::CellOf(lattice.InCells(p)).Cube();
        for (size_t i = out.visits.size(); i-- > first_visit;) {
          if (out.visits[i].key == cube) return;
        }
        out.visits.push_back({cube, index});
      });
      out.leaves.push_back(leaf);
    }
  }

  // Candidate i lies at area (i + 1/2) / n of the running sum of areas.
  void MakeLeaves() {
    const auto n = static_cast<double>(candidates);
    const size_t triangles = shape.triangles.size();
    std::vector<uint32_t> count(triangles);
    double below = 0, first = 0;
    for (size_t t = 0; t < triangles; ++t) {
      below += shape.areas[t];
      const double end =
          t + 1 == triangles ? n : std::clamp(std::ceil(below / shape.area * n - 0.5), first, n);
      count[t] = static_cast<uint32_t>(end - first);
      first = end;
    }
    const float alpha_cutoff = prepared.materials()[object.material].alpha_cutoff;
    const bool masked = alpha_cutoff >= 0.0f;
    std::vector<Piece> pieces((triangles + kTrianglesPerPiece - 1) / kTrianglesPerPiece);
    executor.ForEachPiece(triangles, kTrianglesPerPiece, [&](size_t begin, size_t end) {
      Piece& piece = pieces[begin / kTrianglesPerPiece];
      for (size_t t = begin; t < end; ++t) {
        if (count[t] != 0) {
          SplitTriangle(static_cast<uint32_t>(t), count[t], masked, alpha_cutoff, piece);
        }
      }
    });
    size_t leaf_count = 0, visit_count = 0;
    for (const Piece& piece : pieces) {
      leaf_count += piece.leaves.size();
      visit_count += piece.visits.size();
    }
    leaves.reserve(leaf_count);
    visits.reserve(visit_count);
    for (Piece& piece : pieces) {
      const auto base = static_cast<uint32_t>(leaves.size());
      leaves.insert(leaves.end(), piece.leaves.begin(), piece.leaves.end());
      for (const KeyedIndex& v : piece.visits) visits.push_back({v.key, v.index + base});
      piece = {};
    }
  }
};

ObjectSampler::ObjectSampler(const ObjectShape& shape, const PreparedScene& prepared, size_t object,
                             float spacing_m, uint64_t seed, Executor& executor)
    : impl_(std::make_unique<Impl>(shape, prepared, object, executor)) {
  Impl& impl = *impl_;
  // Exact: the unit is a power of two.
  impl.spacing = static_cast<float>(static_cast<double>(spacing_m) / shape.unit_m);
  uint64_t content = 0;
  for (int i = 0; i < 8; ++i) content = content << 8 | shape.digest.bytes[static_cast<size_t>(i)];
  impl.seed = HashKey(seed, content);
  const double per_surfel = impl.spacing / kSpacingFactor;
  const double wanted = shape.area / (per_surfel * per_surfel) * kCandidatesPerSurfel;
  impl.candidates =
      std::max<uint64_t>(kCandidatesPerSurfel, static_cast<uint64_t>(std::min(wanted, 0x1p40)) + 1);
  Box3f box;
  for (const auto& t : shape.triangles) {
    for (const uint32_t v : t) box.Extend(shape.vertices[v]);
  }
  // Half a cell off, so that a face of a box does not lie in the face of a cell.
  impl.lattice = {box.min - Vec3f(0.5f * impl.spacing), 1.0f / impl.spacing};

  Sha256 hash;
  hash.Update("surfels").UpdateU32(kSamplerVersion).UpdateU64(seed);
  hash.UpdateU32(std::bit_cast<uint32_t>(impl.spacing));
  hash.Update(std::as_bytes(std::span(shape.digest.bytes)));
  if (prepared.materials()[impl.object.material].alpha_cutoff >= 0.0f && shape.area > 0) {
    // What the mask leaves of the candidates is all that decides.
    impl.MakeLeaves();
    for (const Leaf& leaf : impl.leaves) {
      hash.UpdateU32(leaf.triangle).UpdateU32(leaf.kept).UpdateU64(leaf.seed);
    }
  }
  key_ = hash.Finish();
}

ObjectSampler::~ObjectSampler() = default;

ObjectSurfels ObjectSampler::Sample() {
  Impl& impl = *impl_;
  const ObjectShape& shape = impl.shape;
  Executor& executor = impl.executor;
  ObjectSurfels out;
  if (!(shape.area > 0)) return out;
  if (impl.leaves.empty()) impl.MakeLeaves();
  if (impl.leaves.empty()) return out;

  SortByKey(impl.visits, executor);
  struct Cube {
    uint64_t code;
    size_t first_visit, end_visit;
    std::vector<Accepted> accepted;
  };
  std::vector<Cube> cubes;
  for (size_t i = 0; i < impl.visits.size();) {
    size_t end = i + 1;
    while (end < impl.visits.size() && impl.visits[end].key == impl.visits[i].key) ++end;
    cubes.push_back({impl.visits[i].key, i, end, {}});
    i = end;
  }
  // Open addressing by code.
  std::vector<uint32_t> table(std::bit_ceil(cubes.size() * 2 + 1), kNone);
  const auto slot_of = [&](uint64_t code) {
    size_t slot = Mix64(code) & (table.size() - 1);
    while (table[slot] != kNone && cubes[table[slot]].code != code) {
      slot = (slot + 1) & (table.size() - 1);
    }
    return slot;
  };
  for (size_t i = 0; i < cubes.size(); ++i)
    table[slot_of(cubes[i].code)] = static_cast<uint32_t>(i);

  std::vector<Vec3f> normals(shape.triangles.size());
  executor.ForEachPiece(normals.size(), kSurfelsPerPiece, [&](size_t begin, size_t end) {
    for (size_t t = begin; t < end; ++t) normals[t] = impl.NormalOf(static_cast<uint32_t>(t));
  });

  // What one thread needs for a cube.
  struct Candidate {
    Accepted surfel;
    GridPlace place;
  };
  struct Scratch {
    CubeGrid grid;
    std::vector<Candidate> candidates;
    std::vector<uint32_t> order;
  };
  static thread_local std::unique_ptr<Scratch> scratch_of_thread;
  const auto scratch = []() -> Scratch& {
    if (!scratch_of_thread) scratch_of_thread = std::make_unique<Scratch>();
    return *scratch_of_thread;
  };
  // Where a cube's grid begins, one layer outside of it; modulo the size of space in cells.
  constexpr int64_t kCellMask = (int64_t{1} << (kCubeCoordinateBits + kCubeBits)) - 1;
  struct GridOrigin {
    int64_t x, y, z;
    explicit GridOrigin(uint64_t code)
        : x(static_cast<int64_t>(CompactBits(code) << kCubeBits) - 1),
          y(static_cast<int64_t>(CompactBits(code >> 1) << kCubeBits) - 1),
          z(static_cast<int64_t>(CompactBits(code >> 2) << kCubeBits) - 1) {}
    // kGridSide or more if the cell lies outside.
    std::array<int64_t, 3> Place(const Cell& c) const {
      return {(c.x - x) & kCellMask, (c.y - y) & kCellMask, (c.z - z) & kCellMask};
    }
  };
  const auto load_surfels = [&](size_t cube, const GridOrigin& origin, bool own, CubeGrid& grid) {
    grid.Clear(impl.spacing);
    for (int dz = -1; dz <= 1; ++dz) {
      for (int dy = -1; dy <= 1; ++dy) {
        for (int dx = -1; dx <= 1; ++dx) {
          if (dx == 0 && dy == 0 && dz == 0 && !own) continue;
          const uint32_t at = table[slot_of(NeighbourCube(cubes[cube].code, dx, dy, dz))];
          if (at == kNone) continue;
          for (Accepted& a : cubes[at].accepted) {
            const auto [x, y, z] = origin.Place(Lattice::CellOf(impl.lattice.InCells(a.position)));
            if (x >= kGridSide || y >= kGridSide || z >= kGridSide) continue;
            grid.Insert(static_cast<int>(x), static_cast<int>(y), static_cast<int>(z), a.position,
                        normals[a.triangle], &a.share);
          }
        }
      }
    }
  };
  // Calls visit(place, triangle, barycentric, position) for the candidates of a cube.
  const auto for_candidates = [&](const Cube& cube, const GridOrigin& origin, auto&& visit) {
    for (size_t v = cube.first_visit; v < cube.end_visit; ++v) {
      const Leaf& leaf = impl.leaves[impl.visits[v].index];
      impl.ForCandidates(leaf, [&](uint32_t, const Vec2f& b, const Vec3f& p) {
        const Vec3f in_cells = impl.lattice.InCells(p);
        const Cell cell = Lattice::CellOf(in_cells);
        const auto [x, y, z] = origin.Place(cell);
        const auto inside = [](int64_t c) { return c >= 1 && c < kGridSide - 1; };
        if (!inside(x) || !inside(y) || !inside(z)) return;
        const GridPlace place{
            static_cast<int>(x),
            static_cast<int>(y),
            static_cast<int>(z),
            {in_cells.x - static_cast<float>(cell.x), in_cells.y - static_cast<float>(cell.y),
             in_cells.z - static_cast<float>(cell.z)}};
        visit(place, leaf.triangle, b, p);
      });
    }
  };

  std::array<std::vector<uint32_t>, kPhases> phases;
  for (size_t i = 0; i < cubes.size(); ++i) {
    phases[cubes[i].code % kPhases].push_back(static_cast<uint32_t>(i));
  }
  for (const std::vector<uint32_t>& phase : phases) {
    executor.ForEach(phase.size(), 1, [&](size_t i) {
      Scratch& s = scratch();
      Cube& cube = cubes[phase[i]];
      const GridOrigin origin(cube.code);
      s.candidates.clear();
      for_candidates(
          cube, origin,
          [&](const GridPlace& place, uint32_t triangle, const Vec2f& b, const Vec3f& p) {
            s.candidates.push_back({{p, triangle, b, 0}, place});
          });
      load_surfels(phase[i], origin, false, s.grid);
      // A random order (Fisher and Yates), drawn as it is needed.
      const auto n = static_cast<uint32_t>(s.candidates.size());
      s.order.resize(n);
      for (uint32_t k = 0; k < n; ++k) s.order[k] = k;
      uint64_t random = HashKey(impl.seed, cube.code);
      for (uint32_t k = 0; k < n; ++k) {
        random = random * 6364136223846793005ull + 1442695040888963407ull;  // Knuth's MMIX
        const auto j =
            k + static_cast<uint32_t>(((random >> 32) * static_cast<uint64_t>(n - k)) >> 32);
        std::swap(s.order[k], s.order[j]);
        const Candidate& c = s.candidates[s.order[k]];
        const Vec3f& normal = normals[c.surfel.triangle];
        if (s.grid.AnyWithinOneCell(c.place, c.surfel.position, normal)) continue;
        s.grid.Insert(c.place.x, c.place.y, c.place.z, c.surfel.position, normal, nullptr);
        cube.accepted.push_back(c.surfel);
      }
    });
  }

  // Areas: how many candidates have this surfel as their nearest on the same surface. A surfel's
  // share may grow from several cubes at a time; sums of integers have no order.
  executor.ForEach(cubes.size(), 1, [&](size_t i) {
    Scratch& s = scratch();
    const GridOrigin origin(cubes[i].code);
    load_surfels(i, origin, true, s.grid);
    for_candidates(cubes[i], origin,
                   [&](const GridPlace& place, uint32_t triangle, const Vec2f&, const Vec3f& p) {
                     // A surfel is its own nearest, and who was refused has one within a spacing.
                     if (uint32_t* share = s.grid.Nearest(place, p, normals[triangle])) {
                       std::atomic_ref<uint32_t>(*share).fetch_add(1, std::memory_order_relaxed);
                     }
                   });
  });

  std::vector<size_t> first(cubes.size() + 1, 0);
  for (size_t i = 0; i < cubes.size(); ++i) {
    size_t kept = 0;
    for (const Accepted& a : cubes[i].accepted) kept += a.share != 0;
    first[i + 1] = first[i] + kept;
  }
  const double candidate_area = shape.area / static_cast<double>(impl.candidates);
  out.triangle.resize(first.back());
  out.barycentric.resize(first.back());
  out.area.resize(first.back());
  executor.ForEach(cubes.size(), 16, [&](size_t i) {
    size_t at = first[i];
    for (const Accepted& a : cubes[i].accepted) {
      if (a.share == 0) continue;  // two in one place: the other has it all
      out.triangle[at] = a.triangle;
      out.barycentric[at] = a.barycentric;
      out.area[at] = static_cast<float>(candidate_area * a.share);
      ++at;
    }
  });
  return out;
}

float SurfelSpacingM(double area_m2, uint64_t count) {
  if (!(area_m2 > 0) || count == 0) return 0;
  return static_cast<float>(
      RoundMantissa(kSpacingFactor * std::sqrt(area_m2 / static_cast<double>(count)), 7));
}

float DefaultSurfelSpacingM(double area_m2, float diagonal_m) {
  const double edge = static_cast<double>(diagonal_m) / 500.0;
  const double n = edge > 0 ? area_m2 / (edge * edge) : 0;
  if (!(area_m2 > 0)) return 0;
  return static_cast<float>(
      RoundMantissa(kSpacingFactor * std::sqrt(area_m2 / std::clamp(n, 1e5, 4e6)), 3));
}

SurfelCloud PlaceSurfels(const PreparedScene& prepared, std::span<const ObjectShape> shapes,
                         std::span<const std::shared_ptr<const ObjectSurfels>> surfels,
                         Executor& executor) {
  std::vector<size_t> first(surfels.size() + 1, 0);
  for (size_t o = 0; o < surfels.size(); ++o) first[o + 1] = first[o] + surfels[o]->size();
  const size_t n = first.back();
  SurfelCloud cloud;
  cloud.position.resize(n);
  cloud.normal.resize(n);
  cloud.area_m2.resize(n);
  cloud.triangle.resize(n);
  cloud.barycentric.resize(n);
  executor.ForEachPiece(n, kSurfelsPerPiece, [&](size_t begin, size_t end) {
    size_t o =
        static_cast<size_t>(std::upper_bound(first.begin(), first.end(), begin) - first.begin()) -
        1;
    for (size_t i = begin; i < end; ++i) {
      while (i >= first[o + 1]) ++o;
      const ObjectSurfels& from = *surfels[o];
      const size_t k = i - first[o];
      const Vec2f b = from.barycentric[k];
      const auto t = static_cast<uint32_t>(prepared.objects()[o].first_triangle + from.triangle[k]);
      cloud.position[i] = prepared.PointOn(t, b.x, b.y);
      cloud.normal[i] = prepared.GeometricNormal(t);
      cloud.area_m2[i] = static_cast<float>(from.area[k] * (shapes[o].unit_m * shapes[o].unit_m));
      cloud.triangle[i] = t;
      cloud.barycentric[i] = b;
    }
  });
  return cloud;
}

SurfelCloud SampleSurfels(const Scene& scene, const PreparedScene& prepared, uint64_t count,
                          uint64_t seed, Executor& executor) {
  const std::vector<ObjectShape> shapes = MakeObjectShapes(scene, prepared, executor);
  const float spacing_m = SurfelSpacingM(TotalAreaM2(shapes), count);
  if (!(spacing_m > 0)) return {};
  std::vector<std::shared_ptr<const ObjectSurfels>> surfels(shapes.size());
  executor.ForEach(shapes.size(), 1, [&](size_t i) {
    surfels[i] = std::make_shared<const ObjectSurfels>(
        ObjectSampler(shapes[i], prepared, i, spacing_m, seed, executor).Sample());
  });
  return PlaceSurfels(prepared, shapes, surfels, executor);
}

}  // namespace farpoint
