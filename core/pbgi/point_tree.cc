#include "core/pbgi/point_tree.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>

#include "core/base/byte_io.h"
#include "core/base/check.h"
#include "core/math/elementary.h"
#include "core/pbgi/key_sort.h"
#include "core/pbgi/packed_nodes.h"

namespace farpoint {

namespace {

constexpr uint32_t kTopologyMagic = 0x54545046;  // "FPTT"
constexpr uint32_t kRadianceMagic = 0x52545046;  // "FPTR"
constexpr uint32_t kVersion = 4;
constexpr size_t kHeaderBytes = 16;  // magic, version, number of surfels
constexpr size_t kPiece = 4096;
constexpr int kHilbertBits = 16;
// Units of groups; far beyond any scene. kReachUnits bounds a group's distance from the origin in
// its own units, so that kernels that count in them never come to infinity.
constexpr float kLeastUnit = 0x1p-60f, kMostUnit = 0x1p50f, kReachUnits = 0x1p40f;

// What building needs of a node beyond what is stored. All of it from the surfels as they are
// stored.
struct BuildNode {
  Box3f centres;     // of all surfels below
  float max_radius;  // of all surfels below
  double area;
  Vec3d area_normal;  // Σ A n
  Vec3d area_centre;  // Σ A c
};

float Sum(const float (&values)[kLanes]) {
  double sum = 0;
  for (const float v : values) sum += static_cast<double>(v);
  return static_cast<float>(sum);
}

// A group's frame. `reach` is the largest coordinate of the tree.
GroupFrame FrameFor(const Box3f& centres, float radius, float area, float reach) {
  const float width = MaxComponent(centres.max - centres.min);
  // All numbers fit with room for rounding up: centres 2^16, radii 2^15 halves, areas 2^14.
  const float unit =
      PowerOfTwoAbove(std::max({width * (1.0f / 65535.0f), radius * 0x1p-14f,
                                std::sqrt(area) * 0x1p-17f, reach * (1.0f / kReachUnits)}));
  return {{centres.min.x, centres.min.y, centres.min.z}, std::clamp(unit, kLeastUnit, kMostUnit)};
}

uint16_t Steps(float x, float origin, float unit) {
  return static_cast<uint16_t>(std::clamp(std::nearbyint((x - origin) / unit), 0.0f, 65535.0f));
}

template <typename Group>
void PackCentre(const Vec3f& c, uint32_t lane, Group& g) {
  g.x[lane] = Steps(c.x, g.frame.origin[0], g.frame.unit);
  g.y[lane] = Steps(c.y, g.frame.origin[1], g.frame.unit);
  g.z[lane] = Steps(c.z, g.frame.origin[2], g.frame.unit);
}

// A disc of the surfel's area.
float DiscRadius(float area) { return std::sqrt(area * 0.318309886183790672f); }

// The surfels `order[0 … count - 1]`, count in [1, kLanes].
PackedSurfels PackSurfels(const SurfelCloud& cloud, const SurfelSides& open_sides,
                          const uint32_t* order, uint32_t count, float reach) {
  Box3f box;
  float radius = 0;
  for (uint32_t k = 0; k < count; ++k) {
    box.Extend(cloud.position[order[k]]);
    radius = std::max(radius, DiscRadius(cloud.area_m2[order[k]]));
  }
  PackedSurfels g{};
  g.frame = FrameFor(box, radius, 0, reach);
  const float inverse_unit = 1.0f / g.frame.unit;
  for (uint32_t k = 0; k < kLanes; ++k) {
    if (k >= count) {
      g.radius[k] = kEmptyRadius;
      continue;
    }
    const uint32_t i = order[k];
    PackCentre(cloud.position[i], k, g);
    g.normal[k] = PackNormal(cloud.normal[i]) |
                  ((open_sides[i] & kFrontVisible) != 0 ? kPackedFront : 0u) |
                  ((open_sides[i] & kBackVisible) != 0 ? kPackedBack : 0u);
    g.radius[k] = HalfNearest(DiscRadius(cloud.area_m2[i]) * inverse_unit);
  }
  return g;
}

// The node over surfels `s`.
BuildNode OverSurfels(const NodeGroup& s, uint32_t count) {
  BuildNode b{};
  for (uint32_t k = 0; k < count; ++k) {
    const Vec3f centre(s.cx[k], s.cy[k], s.cz[k]);
    const double area = static_cast<double>(s.radius[k]) * static_cast<double>(s.radius[k]);
    b.centres.Extend(centre);
    b.max_radius = std::max(b.max_radius, s.radius[k]);
    b.area += area;
    b.area_normal += Vec3d(Vec3f(s.nx[k], s.ny[k], s.nz[k])) * area;
    b.area_centre += Vec3d(centre) * area;
  }
  b.area *= kPi;
  b.area_normal *= kPi;
  b.area_centre *= kPi;
  return b;
}

// The node over others.
BuildNode OverNodes(const BuildNode* children, uint32_t count) {
  BuildNode b{};
  for (uint32_t k = 0; k < count; ++k) {
    const BuildNode& c = children[k];
    b.centres.Extend(c.centres.min);
    b.centres.Extend(c.centres.max);
    b.max_radius = std::max(b.max_radius, c.max_radius);
    b.area += c.area;
    b.area_normal += c.area_normal;
    b.area_centre += c.area_centre;
  }
  return b;
}

// Holds all discs below a node.
float RadiusByBox(const BuildNode& node, const Vec3f& centre) {
  return Length(Max(node.centres.max - centre, centre - node.centres.min)) + node.max_radius;
}

// What holds all discs below a group, about a centre and a direction.
struct Bounds {
  float radius, thickness, sin_cone;
};

float Largest(F8 v) { return std::max({v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7]}); }

Bounds BoundsOf(const NodeGroup& g, const BuildNode& node, const Vec3f& centre, const Vec3f& unit) {
  const F8 zero = Set8(0.0f), one = Set8(1.0f);
  const F8 radius = Load8(g.radius);
  const M8 used = radius >= zero;
  const V8 offset = V8(Load8(g.cx), Load8(g.cy), Load8(g.cz)) - V8(centre);
  const V8 axis(unit);
  // Two bounds of the radius: over the children's spheres, and over the box of the surfels.
  const float by_children = Largest(Select8(used, Sqrt8(Dot(offset, offset)) + radius, zero));

  const V8 normal = NormalizeOr(V8(Load8(g.nx), Load8(g.ny), Load8(g.nz)), V8(Vec3f(0, 0, 1)));
  const F8 cos_a = Max8(Min8(Dot(normal, axis), one), -one);
  const F8 c = Abs8(cos_a);
  const F8 sin_a = Sqrt8(Max8(one - c * c, zero));
  const F8 reach = Min8(radius, radius * sin_a + Load8(g.thickness) * c);
  const float thickness = Largest(Select8(used, Abs8(Dot(offset, axis)) + reach, zero));
  // cos(a + b) for the angle a between the normals and the child's own cone b.
  const F8 sin_b = Load8(g.sin_cone);
  const F8 cos_b = Sqrt8(Max8(one - sin_b * sin_b, zero));
  const F8 cos_ab = Select8(sin_b >= one, -one, cos_a * cos_b - sin_a * sin_b);
  const float cos_cone = -Largest(Select8(used, -cos_ab, -one));

  // A few ulps wider, so that rounding never puts a disc outside.
  constexpr float kWider = 1.0f + 1e-6f;
  Bounds b;
  b.radius = std::min(by_children, RadiusByBox(node, centre)) * kWider;
  b.thickness = std::min(b.radius, thickness * kWider);
  b.sin_cone = cos_cone <= 0.0f
                   ? 1.0f
                   : std::min(1.0f, std::sqrt(std::max(0.0f, 1.0f - cos_cone * cos_cone)) + 1e-6f);
  return b;
}

// Stores what the children of a lane show.
void SetVisible(const NodeGroup& children, uint32_t lane, PackedNodes& g) {
  const float scale = 1.0f / (g.frame.unit * g.frame.unit * kAreaUnits);
  g.front_area[lane] = HalfNearest(Sum(children.front_area) * scale);
  g.back_area[lane] = HalfNearest(Sum(children.back_area) * scale);
  g.normal[lane] = (g.normal[lane] & ~(kPackedFront | kPackedBack)) |
                   (g.front_area[lane] != 0 ? kPackedFront : 0u) |
                   (g.back_area[lane] != 0 ? kPackedBack : 0u);
}

// `count` nodes, in [1, kLanes]; children(k) gives the unpacked group below lane k.
template <typename Children>
PackedNodes PackNodes(const BuildNode* nodes, uint32_t count, float reach,
                      const Children& children) {
  Box3f box;
  Vec3f centre[kLanes];
  NodeGroup below[kLanes];
  float radius = 0, area = 0;
  for (uint32_t k = 0; k < count; ++k) {
    below[k] = children(k);
    const BuildNode& node = nodes[k];
    // Surfels of no area have their centre in the middle.
    centre[k] = node.area > 0 ? Vec3f(node.area_centre / node.area) : node.centres.Center();
    box.Extend(centre[k]);
    radius = std::max(radius, RadiusByBox(node, centre[k]));
    area = std::max(area, static_cast<float>(node.area));
  }
  PackedNodes g{};
  g.frame = FrameFor(box, radius, area, reach);
  const float inverse_unit = 1.0f / g.frame.unit;
  for (uint32_t k = 0; k < kLanes; ++k) {
    if (k >= count) {
      g.radius[k] = kEmptyRadius;
      continue;
    }
    const BuildNode& node = nodes[k];
    PackCentre(centre[k], k, g);
    g.normal[k] = PackNormal(node.area > 0 ? Vec3f(node.area_normal / node.area) : Vec3f(0, 0, 0));
    const Vec3f mean = UnpackNormal(g.normal[k]);
    const float length = Length(mean);
    const bool scattered = Length2(mean) < kMinCoherence2;
    g.inverse_length[k] = static_cast<uint16_t>(
        (length > 0.0f ? HalfBelow(1.0f / length) : uint16_t{0}) | (scattered ? 0x8000u : 0u));
    const Bounds bounds = BoundsOf(below[k], node, CentreIn(g.frame, g.x[k], g.y[k], g.z[k]),
                                   NormalizeOr(mean, Vec3f(0, 0, 1)));
    g.radius[k] = HalfAbove(bounds.radius * inverse_unit);
    g.thickness[k] = HalfAbove(bounds.thickness * inverse_unit);
    g.sin_cone[k] = HalfAbove(bounds.sin_cone);
    SetVisible(below[k], k, g);
  }
  return g;
}

// Radiance of the sides of a node, and their visible areas.
struct RadianceNode {
  Rgb front, back;
  float front_area, back_area;
};

// Means over the children of each side's radiance, weighted by that side's visible area.
RadianceNode MeanRadiance(const RadianceNode* children, uint32_t count) {
  double front_area = 0, back_area = 0;
  Vec3d front, back;
  for (uint32_t k = 0; k < count; ++k) {
    const RadianceNode& c = children[k];
    front_area += c.front_area;
    back_area += c.back_area;
    front += Vec3d(c.front) * static_cast<double>(c.front_area);
    back += Vec3d(c.back) * static_cast<double>(c.back_area);
  }
  return {front_area > 0 ? Rgb(front / front_area) : Rgb(),
          back_area > 0 ? Rgb(back / back_area) : Rgb(), static_cast<float>(front_area),
          static_cast<float>(back_area)};
}

PackedRadiance PackRadiance(const RadianceNode* nodes, uint32_t count, const RadianceUnit& unit) {
  PackedRadiance r{};
  for (uint32_t k = 0; k < count; ++k) {
    r.front[k] = unit.Pack(nodes[k].front);
    r.back[k] = unit.Pack(nodes[k].back);
  }
  return r;
}

uint32_t GroupsFor(uint64_t nodes) { return static_cast<uint32_t>((nodes + kLanes - 1) / kLanes); }

// Node counts of all levels, surfels first, up to the first that fits one group.
std::vector<uint64_t> LevelSizes(uint64_t surfels) {
  std::vector<uint64_t> sizes;
  for (uint64_t n = surfels; n > 0; n = GroupsFor(n)) {
    sizes.push_back(n);
    if (n <= kLanes) break;
  }
  return sizes;
}

}  // namespace

unsigned NormalClass(const Vec3f& n) {
  const float ax = std::fabs(n.x), ay = std::fabs(n.y), az = std::fabs(n.z);
  if (ax >= ay && ax >= az) return n.x >= 0 ? 0 : 1;
  if (ay >= az) return n.y >= 0 ? 2 : 3;
  return n.z >= 0 ? 4 : 5;
}

uint64_t HilbertIndex(uint32_t x, uint32_t y, uint32_t z) {
  uint32_t a[3] = {x, y, z};
  for (uint32_t q = 1u << (kHilbertBits - 1); q > 1; q >>= 1) {
    const uint32_t p = q - 1;
    for (uint32_t& v : a) {
      if (v & q) {
        a[0] ^= p;
      } else {
        const uint32_t t = (a[0] ^ v) & p;
        a[0] ^= t;
        v ^= t;
      }
    }
  }
  a[1] ^= a[0];
  a[2] ^= a[1];
  uint32_t t = 0;
  for (uint32_t q = 1u << (kHilbertBits - 1); q > 1; q >>= 1) {
    if (a[2] & q) t ^= q - 1;
  }
  for (uint32_t& v : a) v ^= t;
  uint64_t index = 0;
  for (int bit = kHilbertBits - 1; bit >= 0; --bit) {
    for (const uint32_t v : a) index = (index << 1) | ((v >> bit) & 1u);
  }
  return index;
}

std::array<uint64_t, kLanes> HilbertIndex8(U8 x, U8 y, U8 z) {
  U8 a[3] = {x, y, z};
  for (uint32_t q = 1u << (kHilbertBits - 1); q > 1; q >>= 1) {
    const uint32_t p = q - 1;
    for (U8& v : a) {
      const U8 set = reinterpret_cast<U8>((v & q) != 0);
      const U8 t = (a[0] ^ v) & p & ~set;
      a[0] ^= (set & p) | t;
      v ^= t;
    }
  }
  a[1] ^= a[0];
  a[2] ^= a[1];
  U8 t = {};
  for (uint32_t q = 1u << (kHilbertBits - 1); q > 1; q >>= 1) {
    t ^= reinterpret_cast<U8>((a[2] & q) != 0) & (q - 1);
  }
  // Bit i of the 16 goes to bit 3 i.
  const auto spread = [](uint64_t v) {
    v = (v | v << 16) & 0x0000ff0000ffull;
    v = (v | v << 8) & 0x00f00f00f00full;
    v = (v | v << 4) & 0x0c30c30c30c3ull;
    return (v | v << 2) & 0x249249249249ull;
  };
  std::array<uint64_t, kLanes> index;
  for (size_t k = 0; k < kLanes; ++k) {
    index[k] = spread(a[0][k] ^ t[k]) << 2 | spread(a[1][k] ^ t[k]) << 1 | spread(a[2][k] ^ t[k]);
  }
  return index;
}

namespace {

// The levels of a tree over `surfels`.
struct Levels {
  std::vector<uint64_t> sizes;        // nodes, by level
  std::vector<uint32_t> first_group;  // by level
  uint64_t groups = 0;                // of all levels

  explicit Levels(uint64_t surfels) : sizes(LevelSizes(surfels)) {
    for (const uint64_t size : sizes) {
      first_group.push_back(static_cast<uint32_t>(groups));
      groups += GroupsFor(size);
    }
  }
  // Groups of level 0.
  uint64_t leaf_groups() const { return sizes.empty() ? 0 : GroupsFor(sizes[0]); }
  // Nodes in group `at` of a level.
  uint32_t lanes(size_t level, size_t at) const {
    return static_cast<uint32_t>(std::min<uint64_t>(kLanes, sizes[level] - at * kLanes));
  }
};

// Room for an array at the end of a record, every element of which is to be set.
template <typename T>
T* AddArray(BulkVector<std::byte>& record, uint64_t count) {
  const size_t at = record.size();
  const size_t first = (at + sizeof count + kBlobAlignment - 1) / kBlobAlignment * kBlobAlignment;
  record.resize(first + count * sizeof(T));
  std::fill(record.begin() + static_cast<ptrdiff_t>(at),
            record.begin() + static_cast<ptrdiff_t>(first), std::byte{0});
  std::memcpy(record.data() + at, &count, sizeof count);
  return reinterpret_cast<T*>(record.data() + first);
}

BulkVector<std::byte> Header(uint32_t magic, uint64_t surfels, size_t reserve) {
  BulkVector<std::byte> record;
  record.reserve(reserve);
  record.resize(kHeaderBytes);
  std::memcpy(record.data(), &magic, sizeof magic);
  std::memcpy(record.data() + 4, &kVersion, sizeof kVersion);
  std::memcpy(record.data() + 8, &surfels, sizeof surfels);
  return record;
}

Box3f BoxOf(std::span<const Vec3f> points, Executor& executor) {
  constexpr size_t kPoints = size_t{1} << 16;
  std::vector<Box3f> boxes((points.size() + kPoints - 1) / kPoints);
  executor.ForEachPiece(points.size(), kPoints, [&](size_t begin, size_t end) {
    Box3f box;
    for (size_t i = begin; i < end; ++i) box.Extend(points[i]);
    boxes[begin / kPoints] = box;
  });
  Box3f box;
  for (const Box3f& b : boxes) {
    box.Extend(b.min);
    box.Extend(b.max);
  }
  return box;
}

// Surfels by (class, Hilbert index, position in the cloud).
BulkVector<uint32_t> SortSurfels(const SurfelCloud& cloud, const Box3f& box, Executor& executor) {
  const size_t n = cloud.size();
  const float edge = box.empty() ? 0.0f : MaxComponent(box.max - box.min);
  const float scale = edge > 0.0f ? 65535.0f / edge : 0.0f;
  BulkVector<KeyedIndex> keys(n);
  executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; i += kLanes) {
      const auto count = static_cast<uint32_t>(std::min<size_t>(kLanes, end - i));
      U8 x = {}, y = {}, z = {};
      for (uint32_t k = 0; k < count; ++k) {
        const Vec3f q = (cloud.position[i + k] - box.min) * scale;
        x[k] = static_cast<uint32_t>(q.x);
        y[k] = static_cast<uint32_t>(q.y);
        z[k] = static_cast<uint32_t>(q.z);
      }
      const std::array<uint64_t, kLanes> index = HilbertIndex8(x, y, z);
      for (uint32_t k = 0; k < count; ++k) {
        keys[i + k] = {static_cast<uint64_t>(NormalClass(cloud.normal[i + k]))
                               << (3 * kHilbertBits) |
                           index[k],
                       static_cast<uint32_t>(i + k)};
      }
    }
  });
  SortByKey(keys, executor);
  BulkVector<uint32_t> order(n);
  executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) order[i] = keys[i].index;
  });
  return order;
}

}  // namespace

PointTree::Topology PointTree::BuildTopology(const SurfelCloud& cloud,
                                             const SurfelSides& open_sides, Executor& executor) {
  const size_t n = cloud.size();
  FP_CHECK(open_sides.size() == n);
  const Box3f box = BoxOf(cloud.position, executor);
  const float reach = n > 0 ? std::max(MaxAbs(box.min), MaxAbs(box.max)) : 0.0f;
  Topology topology;
  topology.order = SortSurfels(cloud, box, executor);
  const Levels levels(n);
  const uint64_t leaf_groups = levels.leaf_groups(), inner_groups = levels.groups - leaf_groups;
  auto record = Header(kTopologyMagic, n,
                       4 * kBlobAlignment + leaf_groups * sizeof(PackedSurfels) +
                           inner_groups * sizeof(PackedNodes));
  // The record has room for both: it does not move.
  PackedSurfels* const surfels = AddArray<PackedSurfels>(record, leaf_groups);
  PackedNodes* const nodes = AddArray<PackedNodes>(record, inner_groups);

  BulkVector<BuildNode> here(leaf_groups), above;  // nodes of the level at hand, and of the next
  executor.ForEachPiece(leaf_groups, kPiece / kLanes, [&](size_t begin, size_t end) {
    for (size_t g = begin; g < end; ++g) {
      const uint32_t count = levels.lanes(0, g);
      surfels[g] = PackSurfels(cloud, open_sides, &topology.order[g * kLanes], count, reach);
      here[g] = OverSurfels(Unpack(surfels[g]), count);
    }
  });
  for (size_t level = 1; level < levels.sizes.size(); ++level) {
    const size_t groups = GroupsFor(levels.sizes[level]);
    above.resize(groups);
    PackedNodes* const out = nodes + (levels.first_group[level] - leaf_groups);
    executor.ForEachPiece(groups, kPiece / kLanes, [&](size_t begin, size_t end) {
      for (size_t g = begin; g < end; ++g) {
        const uint32_t count = levels.lanes(level, g);
        const BuildNode* const of_group = &here[g * kLanes];
        out[g] = PackNodes(of_group, count, reach, [&](uint32_t k) {
          const size_t child = g * kLanes + k;
          return level == 1 ? Unpack(surfels[child])
                            : Unpack(nodes[levels.first_group[level - 1] - leaf_groups + child]);
        });
        above[g] = OverNodes(of_group, count);
      }
    });
    here.swap(above);
  }
  topology.blob = Blob::FromBulk(std::move(record));
  return topology;
}

Blob PointTree::BuildRadiance(const Topology& topology, const SurfelCloud& cloud,
                              const SurfelSides& open_sides, const SurfelShading& shading,
                              Executor& executor) {
  const size_t n = cloud.size();
  FP_CHECK(topology.order.size() == n && open_sides.size() == n && shading.front.size() == n &&
           shading.back.size() == n && shading.visible_sides.size() == n);
  const Levels levels(n);
  const uint64_t leaf_groups = levels.leaf_groups();
  std::vector<std::vector<uint32_t>> lit_in((n + kPiece - 1) / kPiece);
  std::vector<float> brightest_in(lit_in.size());
  executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
    float brightest = 0;
    for (size_t slot = begin; slot < end; ++slot) {
      const uint32_t i = topology.order[slot];
      const unsigned lit = shading.visible_sides[i] & ~static_cast<unsigned>(open_sides[i]);
      if ((lit & kFrontVisible) != 0) {
        lit_in[begin / kPiece].push_back(static_cast<uint32_t>(slot * 2));
      }
      if ((lit & kBackVisible) != 0) {
        lit_in[begin / kPiece].push_back(static_cast<uint32_t>(slot * 2 + 1));
      }
      brightest =
          std::max({brightest, MaxComponent(shading.front[i]), MaxComponent(shading.back[i])});
    }
    brightest_in[begin / kPiece] = brightest;
  });
  std::vector<uint32_t> lit_sides;
  for (const auto& lit : lit_in) lit_sides.insert(lit_sides.end(), lit.begin(), lit.end());
  float brightest = 0;
  for (const float b : brightest_in) brightest = std::max(brightest, b);
  const RadianceUnit unit = RadianceUnit::For(brightest);

  // Irradiance after further bounces, for the surfels alone.
  const bool bounced = !shading.indirect_front.empty();
  FP_CHECK(!bounced || (shading.indirect_front.size() == n && shading.indirect_back.size() == n));
  float most_indirect = 0;
  for (size_t i = 0; bounced && i < n; ++i) {
    most_indirect = std::max({most_indirect, MaxComponent(shading.indirect_front[i]),
                              MaxComponent(shading.indirect_back[i])});
  }
  const RadianceUnit indirect_unit = RadianceUnit::For(most_indirect);

  auto record = Header(kRadianceMagic, n,
                       7 * kBlobAlignment + lit_sides.size() * sizeof(uint32_t) +
                           (levels.groups + (bounced ? leaf_groups : 0)) * sizeof(PackedRadiance));
  const float units[2] = {unit.unit(), indirect_unit.unit()};
  record.resize(record.size() + sizeof units);
  std::memcpy(record.data() + kHeaderBytes, units, sizeof units);
  std::copy(lit_sides.begin(), lit_sides.end(), AddArray<uint32_t>(record, lit_sides.size()));
  PackedRadiance* const radiance = AddArray<PackedRadiance>(record, levels.groups);
  PackedRadiance* const indirect = AddArray<PackedRadiance>(record, bounced ? leaf_groups : 0);

  BulkVector<RadianceNode> here(leaf_groups), above;
  executor.ForEachPiece(leaf_groups, kPiece / kLanes, [&](size_t begin, size_t end) {
    for (size_t g = begin; g < end; ++g) {
      const uint32_t count = levels.lanes(0, g);
      RadianceNode surfels[kLanes];
      for (uint32_t k = 0; k < count; ++k) {
        const uint32_t i = topology.order[g * kLanes + k];
        const unsigned visible = shading.visible_sides[i] | open_sides[i];
        const float area = cloud.area_m2[i];
        surfels[k] = {shading.front[i], shading.back[i],
                      (visible & kFrontVisible) != 0 ? area : 0.0f,
                      (visible & kBackVisible) != 0 ? area : 0.0f};
      }
      radiance[g] = PackRadiance(surfels, count, unit);
      here[g] = MeanRadiance(surfels, count);
      if (!bounced) continue;
      for (uint32_t k = 0; k < count; ++k) {
        const uint32_t i = topology.order[g * kLanes + k];
        surfels[k].front = shading.indirect_front[i];
        surfels[k].back = shading.indirect_back[i];
      }
      indirect[g] = PackRadiance(surfels, count, indirect_unit);
    }
  });
  for (size_t level = 1; level < levels.sizes.size(); ++level) {
    const size_t groups = GroupsFor(levels.sizes[level]);
    above.resize(groups);
    executor.ForEachPiece(groups, kPiece / kLanes, [&](size_t begin, size_t end) {
      for (size_t g = begin; g < end; ++g) {
        const uint32_t count = levels.lanes(level, g);
        radiance[levels.first_group[level] + g] = PackRadiance(&here[g * kLanes], count, unit);
        above[g] = MeanRadiance(&here[g * kLanes], count);
      }
    });
    here.swap(above);
  }
  return Blob::FromBulk(std::move(record));
}

PointTree::Blobs PointTree::Build(const SurfelCloud& cloud, const SurfelShading& shading,
                                  Executor& executor) {
  Topology topology = BuildTopology(cloud, shading.visible_sides, executor);
  Blob radiance = BuildRadiance(topology, cloud, shading.visible_sides, shading, executor);
  return {std::move(topology.blob), std::move(radiance)};
}

uint64_t PointTree::NodeCount(uint64_t surfels) {
  uint64_t nodes = 0;
  for (const uint64_t size : LevelSizes(surfels)) nodes += size;
  return nodes;
}

absl::Status PointTree::AddVisible(std::span<const uint32_t> lit_sides) {
  if (lit_sides.empty()) return absl::OkStatus();
  own_surfels_.assign(surfels_.begin(), surfels_.end());
  own_nodes_.assign(nodes_.begin(), nodes_.end());
  std::vector<uint32_t> changed;  // groups of the level at hand, ascending
  for (size_t i = 0; i < lit_sides.size(); ++i) {
    const uint32_t slot = lit_sides[i] / 2;
    if (slot >= surfel_count_ || (i > 0 && lit_sides[i] <= lit_sides[i - 1])) {
      return absl::DataLossError("point tree radiance: entry " + std::to_string(i) +
                                 " of the lit sides is out of order or names no surfel");
    }
    own_surfels_[slot / kLanes].normal[slot % kLanes] |=
        lit_sides[i] % 2 == 0 ? kPackedFront : kPackedBack;
    if (changed.empty() || changed.back() != slot / kLanes) changed.push_back(slot / kLanes);
  }
  const Levels levels(surfel_count_);
  const uint64_t leaf_groups = levels.leaf_groups();
  for (size_t level = 1; level < levels.sizes.size(); ++level) {
    size_t kept = 0;
    // The group below is that of the node of the same index.
    for (const uint32_t node : changed) {
      PackedNodes& g = own_nodes_[levels.first_group[level] - leaf_groups + node / kLanes];
      const NodeGroup below =
          level == 1 ? Unpack(own_surfels_[node])
                     : Unpack(own_nodes_[levels.first_group[level - 1] - leaf_groups + node]);
      SetVisible(below, node % kLanes, g);
      if (kept == 0 || changed[kept - 1] != node / kLanes) changed[kept++] = node / kLanes;
    }
    changed.resize(kept);
  }
  surfels_ = own_surfels_;
  nodes_ = own_nodes_;
  return absl::OkStatus();
}

void PointTree::FindExtremes() {
  F8 largest = Set8(0.0f), layers = Set8(1.0f);
  for (const PackedSurfels& g : surfels_) {
    largest = Max8(largest, LoadHalves(g.radius) * Set8(g.frame.unit));
  }
  for (const PackedNodes& g : nodes_) {
    const F8 disc = DiscArea(LoadHalves(g.radius));  // in squared units; of empty slots more than 0
    const F8 area = Max8(LoadHalves(g.front_area), LoadHalves(g.back_area)) * Set8(kAreaUnits);
    layers = Max8(layers, area / Max8(disc, Set8(std::numeric_limits<float>::min())));
  }
  largest_radius_m_ = Largest(largest);
  most_layers_ = Largest(layers);
}

namespace {

bool IsPowerOfTwo(float x, float least, float most) {
  return x >= least && x <= most && (std::bit_cast<uint32_t>(x) & 0x7fffffu) == 0;
}
bool IsSane(const GroupFrame& f) {
  if (!IsPowerOfTwo(f.unit, kLeastUnit, kMostUnit)) return false;
  // Twice what FrameFor leaves, for rounding.
  const float most = f.unit * (2.0f * kReachUnits);
  return std::fabs(f.origin[0]) <= most && std::fabs(f.origin[1]) <= most &&
         std::fabs(f.origin[2]) <= most;
}
bool IsFiniteHalf(uint16_t h) { return h < 0x7c00; }                           // and not negative
bool IsComponent(uint32_t ten_bits) { return (ten_bits & 0x3ffu) != 0x200u; }  // not -512
bool IsNormal(uint32_t word) {
  return IsComponent(word) && IsComponent(word >> 10) && IsComponent(word >> 20);
}

bool IsSane(const PackedSurfels& g, uint32_t count) {
  bool sane = IsSane(g.frame);
  for (uint32_t k = 0; k < kLanes; ++k) {
    sane &= k < count ? IsFiniteHalf(g.radius[k]) && IsNormal(g.normal[k])
                      : g.radius[k] == kEmptyRadius && g.normal[k] == 0;
  }
  return sane;
}

bool IsSane(const PackedNodes& g, uint32_t count) {
  constexpr uint16_t kOne = 0x3c00;
  bool sane = IsSane(g.frame);
  for (uint32_t k = 0; k < kLanes; ++k) {
    const uint32_t visible =
        (g.front_area[k] != 0 ? kPackedFront : 0u) | (g.back_area[k] != 0 ? kPackedBack : 0u);
    sane &= k < count ? IsFiniteHalf(g.radius[k]) && IsNormal(g.normal[k])
                      : g.radius[k] == kEmptyRadius && g.normal[k] == 0;
    sane &= IsFiniteHalf(g.thickness[k]) && g.sin_cone[k] <= kOne &&
            IsFiniteHalf(g.inverse_length[k] & 0x7fffu) && IsFiniteHalf(g.front_area[k]) &&
            IsFiniteHalf(g.back_area[k]) && (g.normal[k] & (kPackedFront | kPackedBack)) == visible;
  }
  return sane;
}

}  // namespace

absl::StatusOr<std::shared_ptr<const PointTree>> PointTree::FromBlobs(Blob topology,
                                                                      Blob radiance) {
  auto tree = std::make_shared<PointTree>();
  uint32_t magic = 0, version = 0;
  uint64_t n = 0, n_radiance = 0;
  ByteReader reader(topology.bytes());
  FP_RETURN_IF_ERROR(reader.Get(magic, "magic"));
  if (magic != kTopologyMagic) return absl::DataLossError("this blob is no point tree topology");
  FP_RETURN_IF_ERROR(reader.Get(version, "version"));
  if (version != kVersion) {
    return absl::DataLossError("point tree topology has version " + std::to_string(version) +
                               ", this program reads version " + std::to_string(kVersion));
  }
  FP_RETURN_IF_ERROR(reader.Get(n, "surfel count"));
  FP_RETURN_IF_ERROR(reader.GetArray(tree->surfels_, "groups of surfels"));
  FP_RETURN_IF_ERROR(reader.GetArray(tree->nodes_, "groups of nodes"));
  FP_RETURN_IF_ERROR(reader.ExpectEnd());

  ByteReader light(radiance.bytes());
  FP_RETURN_IF_ERROR(light.Get(magic, "magic"));
  if (magic != kRadianceMagic) return absl::DataLossError("this blob is no point tree radiance");
  FP_RETURN_IF_ERROR(light.Get(version, "version"));
  if (version != kVersion) {
    return absl::DataLossError("point tree radiance has version " + std::to_string(version) +
                               ", this program reads version " + std::to_string(kVersion));
  }
  FP_RETURN_IF_ERROR(light.Get(n_radiance, "surfel count"));
  float unit = 0, indirect_unit = 0;
  FP_RETURN_IF_ERROR(light.Get(unit, "unit of radiance"));
  FP_RETURN_IF_ERROR(light.Get(indirect_unit, "unit of indirect irradiance"));
  std::span<const uint32_t> lit_sides;
  FP_RETURN_IF_ERROR(light.GetArray(lit_sides, "lit sides"));
  FP_RETURN_IF_ERROR(light.GetArray(tree->radiance_, "groups"));
  FP_RETURN_IF_ERROR(light.GetArray(tree->indirect_, "groups of indirect irradiance"));
  FP_RETURN_IF_ERROR(light.ExpectEnd());

  if (n > (uint64_t{1} << 31) || n != n_radiance) {
    return absl::DataLossError("point tree: topology is of " + std::to_string(n) +
                               " surfels, radiance of " + std::to_string(n_radiance));
  }
  const Levels levels(n);
  tree->first_group_ = levels.first_group;
  for (const uint64_t size : levels.sizes) tree->node_count_ += size;
  if (levels.leaf_groups() != tree->surfels_.size() ||
      levels.groups - levels.leaf_groups() != tree->nodes_.size() ||
      levels.groups != tree->radiance_.size()) {
    return absl::DataLossError("point tree of " + std::to_string(n) + " surfels should have " +
                               std::to_string(levels.leaf_groups()) + " groups of surfels and " +
                               std::to_string(levels.groups) + " in all, the blobs have " +
                               std::to_string(tree->surfels_.size()) + ", " +
                               std::to_string(tree->surfels_.size() + tree->nodes_.size()) +
                               " and radiance of " + std::to_string(tree->radiance_.size()));
  }
  if (!tree->indirect_.empty() && tree->indirect_.size() != levels.leaf_groups()) {
    return absl::DataLossError("point tree of " + std::to_string(n) + " surfels has " +
                               std::to_string(tree->indirect_.size()) +
                               " groups of indirect irradiance; it should have none or " +
                               std::to_string(levels.leaf_groups()));
  }
  // One pass over the numbers: kernels trust them afterwards.
  bool sane =
      IsPowerOfTwo(unit, 0x1p-126f, 0x1p88f) && IsPowerOfTwo(indirect_unit, 0x1p-126f, 0x1p88f);
  for (size_t level = 0; level < levels.sizes.size(); ++level) {
    const size_t groups = GroupsFor(levels.sizes[level]);
    for (size_t g = 0; g < groups; ++g) {
      const uint32_t count = levels.lanes(level, g);
      sane &=
          level == 0
              ? IsSane(tree->surfels_[g], count)
              : IsSane(tree->nodes_[levels.first_group[level] - levels.leaf_groups() + g], count);
    }
  }
  if (!sane) return absl::DataLossError("point tree holds values that no tree can have");
  constexpr uint32_t kMantissas = (1u << 27) - 1;
  uint32_t light_bits = 0;
  for (const PackedRadiance& r : tree->radiance_) {
    for (uint32_t k = 0; k < kLanes; ++k) light_bits |= r.front[k] | r.back[k];
  }
  tree->surfel_count_ = n;
  tree->unit_ = RadianceUnit(unit);
  tree->indirect_unit_ = RadianceUnit(indirect_unit);
  tree->lit_ = (light_bits & kMantissas) != 0;
  FP_RETURN_IF_ERROR(tree->AddVisible(lit_sides));
  tree->FindExtremes();
  if (lit_sides.empty()) tree->topology_ = std::move(topology);
  tree->radiance_blob_ = std::move(radiance);
  return std::shared_ptr<const PointTree>(std::move(tree));
}

}  // namespace farpoint
