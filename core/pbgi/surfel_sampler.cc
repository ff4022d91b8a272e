#include "core/pbgi/surfel_sampler.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>

#include "core/math/sampling.h"
#include "core/pbgi/candidate_lanes.h"
#include "core/pbgi/cube_darts.h"
#include "core/pbgi/key_sort.h"

namespace farpoint {

namespace {

constexpr int kCandidatesPerSurfel = 8;
// Distance between surfels over sqrt(area / count): with eight candidates each, dart throwing at
// this distance keeps about `count` of them (measured: within 2 % on planes).
constexpr double kSpacingFactor = 0.759;
constexpr uint64_t kCubeCoordinateMask = (uint64_t{1} << kCubeCoordinateBits) - 1;
constexpr uint32_t kNone = ~0u;
// Of a piece of work: triangles, candidates.
constexpr size_t kTrianglesPerPiece = 1024;
constexpr uint32_t kCandidatesPerPiece = 1u << 15;
constexpr size_t kSurfelsPerPiece = size_t{1} << 14;
constexpr uint32_t kSamplerVersion = 2;
// Bits of the spacing in an object's own unit: fewer than a float has, so that a scene modelled in
// another unit, whose spacing is another float, has the same surfels.
constexpr int kSpacingBits = 16;

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

// Morton code of a cube; its lowest three bits tell the cube's phase.
uint64_t CubeCode(uint64_t x, uint64_t y, uint64_t z) {
  return SpreadBits(x) | SpreadBits(y) << 1 | SpreadBits(z) << 2;
}
constexpr unsigned kPhases = 8;

uint64_t NeighbourCube(uint64_t cube, int dx, int dy, int dz) {
  return SpreadBits(CompactBits(cube) + static_cast<uint64_t>(dx)) |
         SpreadBits(CompactBits(cube >> 1) + static_cast<uint64_t>(dy)) << 1 |
         SpreadBits(CompactBits(cube >> 2) + static_cast<uint64_t>(dz)) << 2;
}

// The cube's coordinates.
std::array<uint32_t, 3> CubeOf(uint64_t code) {
  return {static_cast<uint32_t>(CompactBits(code)), static_cast<uint32_t>(CompactBits(code >> 1)),
          static_cast<uint32_t>(CompactBits(code >> 2))};
}

// A part of a triangle with its share of the candidates.
struct TrianglePart {
  std::array<Vec2f, 3> corner;  // barycentric
  uint32_t count;
  uint64_t seed;
};

}  // namespace

struct ObjectSampler::Impl {
  const ObjectShape& shape;
  const PreparedScene& prepared;
  const PreparedObject& object;
  Executor& executor;
  float spacing = 0;        // units
  uint64_t seed = 0;        // of this shape
  uint64_t candidates = 0;  // drawn, those in holes included
  Lattice lattice{};

  // A run of triangles, or a part of a large one.
  struct Job {
    size_t first_triangle, end_triangle;
    TrianglePart part;
    bool whole;  // no part
  };
  struct Piece {
    std::vector<CandidateLeaf> leaves;
    std::vector<KeyedIndex> visits;  // cube, leaf: each once
  };
  BulkVector<CandidateLeaf> leaves;
  BulkVector<KeyedIndex> visits;

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

  // Calls visit(lanes) for the kept candidates of a leaf.
  template <typename Visit>
  void ForCandidates(const CandidateLeaf& leaf, Visit&& visit) const {
    const auto& t = shape.triangles[leaf.triangle];
    const Vec3f a = shape.vertices[t[0]];
    farpoint::ForCandidates(leaf, a, shape.vertices[t[1]] - a, shape.vertices[t[2]] - a, lattice,
                            visit);
  }

  TrianglePart WholeTriangle(uint32_t triangle, uint32_t count) const {
    return {{Vec2f{0, 0}, {1, 0}, {0, 1}}, count, HashKey(seed, triangle)};
  }

  // Halves a part of a triangle across its longest edge. The first half comes first in the order of
  // leaves.
  std::array<TrianglePart, 2> Halves(uint32_t triangle, const TrianglePart& part) const {
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
    return {TrianglePart{{a, m, c}, first, next},
            TrianglePart{{m, b, c}, part.count - first, Mix64(next ^ 0x55)}};
  }

  // The leaves of a part of a triangle.
  void SplitPart(uint32_t triangle, const TrianglePart& whole, bool masked, float alpha_cutoff,
                 std::vector<TrianglePart>& todo, Piece& out) const {
    todo.assign(1, whole);
    while (!todo.empty()) {
      const TrianglePart part = todo.back();
      todo.pop_back();
      if (part.count == 0) continue;
      if (part.count > CandidateLeaf::kMaxCandidates) {
        const auto halves = Halves(triangle, part);
        todo.push_back(halves[1]);
        todo.push_back(halves[0]);
        continue;
      }
      CandidateLeaf leaf{part.corner, triangle, ~0u >> (32 - part.count), Mix64(part.seed ^ 0xaa)};
      if (masked) {
        uint32_t kept = 0;
        const auto t = static_cast<uint32_t>(object.first_triangle + triangle);
        ForCandidates(leaf, [&](const CandidateLanes& lanes) {
          for (uint32_t rest = lanes.kept; rest != 0; rest &= rest - 1) {
            const auto k = static_cast<uint32_t>(std::countr_zero(rest));
            if (prepared.Alpha(t, lanes.b1[k], lanes.b2[k]) >= alpha_cutoff) {
              kept |= 1u << (lanes.first + k);
            }
          }
        });
        leaf.kept = kept;
        if (kept == 0) continue;
      }
      const auto index = static_cast<uint32_t>(out.leaves.size());
      const size_t first_visit = out.visits.size();
      ForCandidates(leaf, [&](const CandidateLanes& lanes) {
        const U8 x = lanes.cell_x >> kCubeBits, y = lanes.cell_y >> kCubeBits,
                 z = lanes.cell_z >> kCubeBits;
        for (uint32_t rest = lanes.kept; rest != 0;) {
          // All that lie in the cube of the first.
          const auto k = static_cast<size_t>(std::countr_zero(rest));
          rest &= ~Bits8(reinterpret_cast<M8>((x == x[k]) & (y == y[k]) & (z == z[k])));
          const uint64_t cube = CubeCode(x[k], y[k], z[k]);
          bool known = false;
          for (size_t i = first_visit; i < out.visits.size(); ++i) {
            known |= out.visits[i].key == cube;
          }
          if (!known) out.visits.push_back({cube, index});
        }
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
    const std::vector<Job> jobs = MakeJobs(count);
    const float alpha_cutoff = prepared.materials()[object.material].alpha_cutoff;
    const bool masked = alpha_cutoff >= 0.0f;
    std::vector<Piece> pieces(jobs.size());
    executor.ForEach(jobs.size(), 1, [&](size_t i) {
      const Job& job = jobs[i];
      std::vector<TrianglePart> todo;
      for (size_t t = job.first_triangle; t < job.end_triangle; ++t) {
        if (count[t] == 0) continue;
        const auto triangle = static_cast<uint32_t>(t);
        SplitPart(triangle, job.whole ? WholeTriangle(triangle, count[t]) : job.part, masked,
                  alpha_cutoff, todo, pieces[i]);
      }
    });
    std::vector<size_t> first_leaf(jobs.size() + 1, 0), first_visit(jobs.size() + 1, 0);
    for (size_t i = 0; i < pieces.size(); ++i) {
      first_leaf[i + 1] = first_leaf[i] + pieces[i].leaves.size();
      first_visit[i + 1] = first_visit[i] + pieces[i].visits.size();
    }
    leaves.resize(first_leaf.back());
    visits.resize(first_visit.back());
    executor.ForEach(pieces.size(), 1, [&](size_t i) {
      Piece& piece = pieces[i];
      std::copy(piece.leaves.begin(), piece.leaves.end(),
                leaves.begin() + static_cast<ptrdiff_t>(first_leaf[i]));
      for (size_t v = 0; v < piece.visits.size(); ++v) {
        visits[first_visit[i] + v] = {piece.visits[v].key,
                                      piece.visits[v].index + static_cast<uint32_t>(first_leaf[i])};
      }
      piece = {};
    });
  }

  // Pieces of work of nearly one size, in the order of the leaves: a large triangle makes several.
  std::vector<Job> MakeJobs(const std::vector<uint32_t>& count) const {
    std::vector<Job> jobs;
    std::vector<TrianglePart> todo;
    size_t begin = 0;
    uint64_t pending = 0;
    const auto flush = [&](size_t end) {
      if (pending > 0) jobs.push_back({begin, end, {}, true});
      begin = end;
      pending = 0;
    };
    for (size_t t = 0; t < count.size(); ++t) {
      if (count[t] <= kCandidatesPerPiece) {
        pending += count[t];
        if (pending >= kCandidatesPerPiece || t + 1 - begin >= kTrianglesPerPiece) flush(t + 1);
        continue;
      }
      flush(t);
      const auto triangle = static_cast<uint32_t>(t);
      todo.assign(1, WholeTriangle(triangle, count[t]));
      while (!todo.empty()) {
        const TrianglePart part = todo.back();
        todo.pop_back();
        if (part.count > kCandidatesPerPiece) {
          const auto halves = Halves(triangle, part);
          todo.push_back(halves[1]);
          todo.push_back(halves[0]);
        } else {
          jobs.push_back({t, t + 1, part, false});
        }
      }
      begin = t + 1;
    }
    flush(count.size());
    return jobs;
  }
};

ObjectSampler::ObjectSampler(const ObjectShape& shape, const PreparedScene& prepared, size_t object,
                             float spacing_m, uint64_t seed, Executor& executor)
    : impl_(std::make_unique<Impl>(shape, prepared, object, executor)) {
  Impl& impl = *impl_;
  impl.spacing = static_cast<float>(
      RoundMantissa(static_cast<double>(spacing_m) / shape.unit_m, kSpacingBits));
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
    for (const CandidateLeaf& leaf : impl.leaves) {
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
    std::vector<AcceptedCandidate> accepted;
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
  static thread_local std::unique_ptr<CubeDarts> darts_of_thread;
  static_assert(kCubeBits == 4);
  // With the candidates of a cube, and the surfels that there are about it.
  const auto load = [&](size_t at, bool own) -> CubeDarts& {
    if (!darts_of_thread) darts_of_thread = std::make_unique<CubeDarts>();
    CubeDarts& darts = *darts_of_thread;
    darts.Clear(impl.spacing);
    const Cube& cube = cubes[at];
    const std::array<uint32_t, 3> place = CubeOf(cube.code);
    const std::array<uint32_t, 3> first_cell = {place[0] << kCubeBits, place[1] << kCubeBits,
                                                place[2] << kCubeBits};
    for (size_t v = cube.first_visit; v < cube.end_visit; ++v) {
      const CandidateLeaf& leaf = impl.leaves[impl.visits[v].index];
      const Vec3f& normal = normals[leaf.triangle];
      impl.ForCandidates(leaf, [&](const CandidateLanes& lanes) {
        const auto inside = reinterpret_cast<M8>((lanes.cell_x >> kCubeBits == place[0]) &
                                                 (lanes.cell_y >> kCubeBits == place[1]) &
                                                 (lanes.cell_z >> kCubeBits == place[2]));
        darts.Add(lanes, Bits8(inside) & lanes.kept, first_cell, leaf.triangle, normal);
      });
    }
    for (int dz = -1; dz <= 1; ++dz) {
      for (int dy = -1; dy <= 1; ++dy) {
        for (int dx = -1; dx <= 1; ++dx) {
          if (dx == 0 && dy == 0 && dz == 0 && !own) continue;
          const uint32_t neighbour = table[slot_of(NeighbourCube(cube.code, dx, dy, dz))];
          if (neighbour == kNone) continue;
          // Of a neighbour the layer of cells that touches the cube.
          const auto layer = [](int d) { return d < 0 ? kCubeCells - 1 : 0; };
          const uint32_t mask =
              (dx != 0 ? 0x00fu : 0u) | (dy != 0 ? 0x0f0u : 0u) | (dz != 0 ? 0xf00u : 0u);
          const uint32_t touching =
              static_cast<uint32_t>(layer(dx) | layer(dy) << 4 | layer(dz) << 8) & mask;
          for (AcceptedCandidate& a : cubes[neighbour].accepted) {
            if ((a.cell & mask) != touching) continue;
            const auto local = [&](int d, int shift) {
              return d * kCubeCells + static_cast<int>(a.cell >> shift & 0xfu);
            };
            darts.AddSurfel({local(dx, 0), local(dy, 4), local(dz, 8)}, a.position,
                            normals[a.triangle], &a.share);
          }
        }
      }
    }
    return darts;
  };

  std::array<std::vector<uint32_t>, kPhases> phases;
  for (size_t i = 0; i < cubes.size(); ++i) {
    phases[cubes[i].code % kPhases].push_back(static_cast<uint32_t>(i));
  }
  for (const std::vector<uint32_t>& phase : phases) {
    executor.ForEach(phase.size(), 1, [&](size_t i) {
      Cube& cube = cubes[phase[i]];
      load(phase[i], false).Throw(HashKey(impl.seed, cube.code), cube.accepted);
    });
  }

  // A surfel's share may grow from several cubes at a time; sums of integers have no order. A
  // surfel is its own nearest, and who was refused has one within a spacing.
  executor.ForEach(cubes.size(), 1, [&](size_t i) { load(i, true).AssignShares(); });

  std::vector<size_t> first(cubes.size() + 1, 0);
  for (size_t i = 0; i < cubes.size(); ++i) {
    size_t kept = 0;
    for (const AcceptedCandidate& a : cubes[i].accepted) kept += a.share != 0;
    first[i + 1] = first[i] + kept;
  }
  const double candidate_area = shape.area / static_cast<double>(impl.candidates);
  out.triangle.resize(first.back());
  out.barycentric.resize(first.back());
  out.area.resize(first.back());
  executor.ForEach(cubes.size(), 16, [&](size_t i) {
    size_t at = first[i];
    for (const AcceptedCandidate& a : cubes[i].accepted) {
      if (a.share == 0) continue;  // two in one place: the other has it all
      out.triangle[at] = a.triangle;
      out.barycentric[at] = a.barycentric;
      out.area[at] = static_cast<float>(candidate_area * a.share);
      ++at;
    }
  });
  return out;
}

namespace {

float RoundedSpacingM(const SurfaceSize& size, double count, int bits) {
  if (!(size.area_m2 > 0) || !(size.largest_m2 > 0) || !(count > 0)) return 0;
  const double unit_m = std::sqrt(size.largest_m2);
  return static_cast<float>(
      unit_m *
      RoundMantissa(kSpacingFactor * std::sqrt(size.area_m2 / size.largest_m2 / count), bits));
}

}  // namespace

float SurfelSpacingM(const SurfaceSize& size, uint64_t count) {
  return RoundedSpacingM(size, static_cast<double>(count), 7);
}

float DefaultSurfelSpacingM(const SurfaceSize& size, float diagonal_m, uint64_t least,
                            uint64_t most) {
  const double edge = static_cast<double>(diagonal_m) / 500.0;
  const double n = std::min(edge > 0 ? size.area_m2 / (edge * edge) : 0, static_cast<double>(most));
  return RoundedSpacingM(size, std::clamp(n, static_cast<double>(least), 4e6), 3);
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
  // Each triangle's normal once, where most have surfels.
  const size_t triangles = prepared.triangles().size();
  std::vector<Vec3f> normals(triangles <= n ? triangles : 0);
  executor.ForEachPiece(normals.size(), kTrianglesPerPiece, [&](size_t begin, size_t end) {
    for (size_t t = begin; t < end; ++t) {
      normals[t] = prepared.GeometricNormal(static_cast<uint32_t>(t));
    }
  });
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
      cloud.normal[i] = normals.empty() ? prepared.GeometricNormal(t) : normals[t];
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
  const std::vector<uint8_t> repeated = RepeatedObjects(prepared, executor);
  const float spacing_m = SurfelSpacingM(SizeOf(shapes, repeated), count);
  if (!(spacing_m > 0)) return {};
  std::vector<std::shared_ptr<const ObjectSurfels>> surfels(shapes.size());
  executor.ForEach(shapes.size(), 1, [&](size_t i) {
    if (repeated[i] != 0) {
      surfels[i] = std::make_shared<const ObjectSurfels>();
      return;
    }
    surfels[i] = std::make_shared<const ObjectSurfels>(
        ObjectSampler(shapes[i], prepared, i, spacing_m, seed, executor).Sample());
  });
  return PlaceSurfels(prepared, shapes, surfels, executor);
}

}  // namespace farpoint
