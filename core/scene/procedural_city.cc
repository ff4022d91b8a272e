// A city of perimeter blocks: every block has four corner buildings around a courtyard, or is a
// park. Buildings, trees, lamps and cars are drawn from small libraries and instanced. All sizes
// are metres; y is up. Every choice is a hash of the seed and of what it decides.
#include <algorithm>
#include <array>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"

namespace farpoint {

namespace {

// Plan of the streets.
constexpr double kPitch = 60;       // from street to street
constexpr double kKerbHalf = 25.5;  // half of a block with its pavements
constexpr double kLotHalf = 22;     // half of what is built upon
constexpr double kKerbHeight = 0.15;
constexpr double kMargin = 16;  // of the ground beyond the outermost streets' axes

// Plan of a building, in the frame of its lot: the street corner is (0, 0), the streets run along
// +x and +z. The plan is an L round the courtyard.
constexpr double kSide = 22;   // along each street
constexpr double kDepth = 13;  // from the street to the courtyard
constexpr double kFloorHeight = 3.5;
constexpr double kGroundHeight = 4.4;
constexpr double kBay = 4.4;  // width of a bay; about
constexpr double kArcadeDepth = 3.0;
constexpr double kWallThickness = 0.5;

enum CityMaterial : int32_t {
  kAsphalt,
  kPaint,
  kPavement,
  kKerb,
  kGrass,
  kGravel,
  kWater,
  kStone,
  kGlass,
  kFrame,
  kSlate,
  kTiles,
  kRoofFelt,
  kMetal,
  kDarkMetal,
  kBark,
  kRubber,
  kFirstLeaves,
  kFirstWall = kFirstLeaves + 3,
  kFirstAccent = kFirstWall + 10,
  kFirstPaintwork = kFirstAccent + 4,
  kMaterialCount = kFirstPaintwork + 5
};

struct NamedColor {
  const char* name;
  Rgb albedo;
};

constexpr int kWallColors = 10, kAccentColors = 4, kPaintworks = 5, kLeafColors = 3;

std::vector<Material> CityMaterials() {
  const NamedColor colors[kMaterialCount] = {
      {"asphalt", {0.085f, 0.085f, 0.09f}},       {"road paint", {0.62f, 0.61f, 0.57f}},
      {"pavement", {0.36f, 0.345f, 0.32f}},       {"kerb", {0.48f, 0.47f, 0.45f}},
      {"grass", {0.11f, 0.21f, 0.045f}},          {"gravel", {0.52f, 0.46f, 0.36f}},
      {"water", {0.06f, 0.14f, 0.17f}},           {"stone", {0.64f, 0.6f, 0.53f}},
      {"glass", {0.05f, 0.07f, 0.085f}},          {"frame", {0.7f, 0.69f, 0.66f}},
      {"slate", {0.13f, 0.14f, 0.165f}},          {"tiles", {0.46f, 0.17f, 0.09f}},
      {"roof felt", {0.27f, 0.265f, 0.255f}},     {"metal", {0.5f, 0.51f, 0.52f}},
      {"dark metal", {0.07f, 0.08f, 0.08f}},      {"bark", {0.16f, 0.105f, 0.065f}},
      {"rubber", {0.03f, 0.03f, 0.03f}},          {"leaves 0", {0.1f, 0.21f, 0.04f}},
      {"leaves 1", {0.15f, 0.25f, 0.05f}},        {"leaves 2", {0.07f, 0.16f, 0.045f}},
      {"plaster cream", {0.74f, 0.63f, 0.45f}},   {"plaster ochre", {0.7f, 0.47f, 0.2f}},
      {"brick red", {0.42f, 0.155f, 0.095f}},     {"plaster blue", {0.42f, 0.54f, 0.66f}},
      {"plaster mint", {0.47f, 0.61f, 0.46f}},    {"plaster rose", {0.72f, 0.44f, 0.38f}},
      {"plaster white", {0.76f, 0.74f, 0.69f}},   {"sandstone", {0.57f, 0.49f, 0.38f}},
      {"terracotta", {0.64f, 0.29f, 0.155f}},     {"brick brown", {0.3f, 0.2f, 0.14f}},
      {"awning red", {0.56f, 0.055f, 0.045f}},    {"awning green", {0.05f, 0.27f, 0.1f}},
      {"awning blue", {0.055f, 0.13f, 0.42f}},    {"awning yellow", {0.7f, 0.47f, 0.06f}},
      {"paintwork white", {0.7f, 0.7f, 0.7f}},    {"paintwork grey", {0.2f, 0.21f, 0.22f}},
      {"paintwork red", {0.45f, 0.03f, 0.03f}},   {"paintwork blue", {0.05f, 0.1f, 0.32f}},
      {"paintwork yellow", {0.68f, 0.48f, 0.03f}}};
  std::vector<Material> materials;
  for (const NamedColor& color : colors) {
    Material material;
    material.name = color.name;
    material.base_color = color.albedo;
    material.metallic = 0;
    materials.push_back(std::move(material));
  }
  return materials;
}

// A number in [0, 1) for each key.
template <typename... Key>
double Random(Key... key) {
  return static_cast<double>(HashKey(static_cast<uint64_t>(key)...) >> 11) * 0x1p-53;
}
template <typename... Key>
int RandomInt(int count, Key... key) {
  return static_cast<int>(Random(key...) * count);
}

// What a number decides; part of its key.
enum Choice : uint64_t {
  kWallChoice = 1,
  kFloorsChoice,
  kArcadeChoice,
  kRoofChoice,
  kAccentChoice,
  kBalconyChoice,
  kRoofObjectChoice,
  kShopChoice,
  kVariantChoice,
  kMirrorChoice,
  kParkChoice,
  kTreeChoice,
  kCarChoice,
  kLeafChoice,
  kWindowChoice,
  kLampChoice
};

// Triangles of one material.
class Solid {
 public:
  bool empty() const { return triangles_.empty(); }

  // a, b, c, d counter-clockwise as seen from the front.
  void Quad(const Vec3d& a, const Vec3d& b, const Vec3d& c, const Vec3d& d) {
    const auto first = Add({a, b, c, d});
    triangles_.push_back({first, first + 1, first + 2});
    triangles_.push_back({first, first + 2, first + 3});
  }
  void Triangle(const Vec3d& a, const Vec3d& b, const Vec3d& c) {
    const auto first = Add({a, b, c});
    triangles_.push_back({first, first + 1, first + 2});
  }
  // Without its bottom.
  void Box(const Vec3d& min, const Vec3d& max, bool with_bottom = false) {
    const double x[2] = {min.x, max.x}, y[2] = {min.y, max.y}, z[2] = {min.z, max.z};
    const auto first = static_cast<uint32_t>(positions_.size());
    for (int i = 0; i < 8; ++i)
      positions_.emplace_back(Vec3f(Vec3d(x[i & 1], y[i >> 1 & 1], z[i >> 2])));
    const std::array<uint32_t, 4> faces[6] = {{2, 6, 7, 3}, {0, 2, 3, 1}, {4, 5, 7, 6},
                                              {0, 4, 6, 2}, {1, 3, 7, 5}, {0, 1, 5, 4}};
    for (int f = 0; f < (with_bottom ? 6 : 5); ++f) {
      const auto& q = faces[f];
      triangles_.push_back({first + q[0], first + q[1], first + q[2]});
      triangles_.push_back({first + q[0], first + q[2], first + q[3]});
    }
  }
  // A prism of `sides` sides about the vertical through `center`, tapering from r0 at y0 to r1 at
  // y1, open below, with a lid unless it ends in a point.
  void Prism(const Vec3d& center, int sides, double r0, double y0, double r1, double y1) {
    const auto first = static_cast<uint32_t>(positions_.size());
    for (int i = 0; i < sides; ++i) {
      const SinCos a = DetSinCos(2 * kPi * i / sides);
      positions_.emplace_back(Vec3f(Vec3d(center.x + r0 * a.cos, y0, center.z - r0 * a.sin)));
      positions_.emplace_back(Vec3f(Vec3d(center.x + r1 * a.cos, y1, center.z - r1 * a.sin)));
    }
    const auto n = static_cast<uint32_t>(sides);
    for (uint32_t i = 0; i < n; ++i) {
      const uint32_t a = first + 2 * i, b = first + 2 * ((i + 1) % n);
      if (r1 > 0) {
        triangles_.push_back({a, b, b + 1});
        triangles_.push_back({a, b + 1, a + 1});
        if (i >= 2) triangles_.push_back({first + 1, first + 2 * i - 1, first + 2 * i + 1});
      } else {
        triangles_.push_back({a, b, a + 1});
      }
    }
  }

  Mesh ToMesh(std::string name, int32_t material) const {
    Mesh mesh;
    mesh.name = std::move(name);
    mesh.material = material;
    mesh.positions = positions_;
    mesh.triangles = triangles_;
    return mesh;
  }

 private:
  uint32_t Add(std::initializer_list<Vec3d> points) {
    const auto first = static_cast<uint32_t>(positions_.size());
    for (const Vec3d& p : points) positions_.emplace_back(Vec3f(p));
    return first;
  }
  std::vector<Vec3f> positions_;
  std::vector<std::array<uint32_t, 3>> triangles_;
};

// An upright plane: `u` runs to the right of someone who looks at its front, v upwards, and depth
// grows towards them.
struct Facade {
  Vec3d origin, u, n;

  Vec3d At(double along, double v, double depth = 0) const {
    return origin + u * along + Vec3d(0, v, 0) + n * depth;
  }
  Facade Moved(double along, double v, double depth) const { return {At(along, v, depth), u, n}; }
};

void Panel(Solid& solid, const Facade& f, double u0, double v0, double u1, double v1,
           double depth = 0) {
  solid.Quad(f.At(u0, v0, depth), f.At(u1, v0, depth), f.At(u1, v1, depth), f.At(u0, v1, depth));
}

// The four sides of an opening, from depth 0 back to -depth.
void Reveal(Solid& solid, const Facade& f, double u0, double v0, double u1, double v1,
            double depth) {
  const double d = -depth;
  solid.Quad(f.At(u0, v0), f.At(u1, v0), f.At(u1, v0, d), f.At(u0, v0, d));
  solid.Quad(f.At(u0, v1, d), f.At(u1, v1, d), f.At(u1, v1), f.At(u0, v1));
  solid.Quad(f.At(u0, v0, d), f.At(u0, v1, d), f.At(u0, v1), f.At(u0, v0));
  solid.Quad(f.At(u1, v0), f.At(u1, v1), f.At(u1, v1, d), f.At(u1, v0, d));
}

// A bar that stands out by `depth`: front, top, bottom and ends.
void Ledge(Solid& solid, const Facade& f, double u0, double v0, double u1, double v1,
           double depth) {
  Panel(solid, f, u0, v0, u1, v1, depth);
  solid.Quad(f.At(u0, v1, depth), f.At(u1, v1, depth), f.At(u1, v1), f.At(u0, v1));
  solid.Quad(f.At(u0, v0), f.At(u1, v0), f.At(u1, v0, depth), f.At(u0, v0, depth));
  solid.Quad(f.At(u0, v0), f.At(u0, v0, depth), f.At(u0, v1, depth), f.At(u0, v1));
  solid.Quad(f.At(u1, v0, depth), f.At(u1, v0), f.At(u1, v1), f.At(u1, v1, depth));
}

enum Part {
  kWallPart,
  kStonePart,
  kGlassPart,
  kFramePart,
  kRoofPart,
  kAccentPart,
  kMetalPart,
  kPartCount
};

struct BuildingStyle {
  uint64_t seed;
  int wall, accent, roof_material;
  int floors;  // above the ground floor
  bool arcade, mansard, balconies, tall_windows;
  int setback;  // floors above which the building steps back; 0: none
};

class Building {
 public:
  explicit Building(const BuildingStyle& style) : s_(style) {}

  void Build() {
    const double lower_floors = s_.setback > 0 ? s_.setback : s_.floors;
    const double eaves = kGroundHeight + lower_floors * kFloorHeight;
    const Facade street_z{{kSide, 0, 0}, {-1, 0, 0}, {0, 0, -1}};
    const Facade street_x{{0, 0, 0}, {0, 0, 1}, {-1, 0, 0}};
    StreetFacade(street_z, kSide, 0, static_cast<int>(lower_floors), 0);
    StreetFacade(street_x, kSide, 0, static_cast<int>(lower_floors), 1);
    GroundFloor(street_z, street_x);
    Backs(0, kSide, kDepth, 0, eaves);
    if (s_.setback > 0) {
      RoofDeck(0, kSide, kDepth, eaves, false);
      UpperStoreys(eaves);
    } else {
      Roof(eaves);
    }
  }

  // Adds one mesh for each material that the building has.
  std::vector<uint32_t> AddTo(Scene& scene, const std::string& name) const {
    const int32_t material[kPartCount] = {
        kFirstWall + s_.wall,     kStone, kGlass, kFrame, s_.roof_material,
        kFirstAccent + s_.accent, kMetal};
    const char* part_name[kPartCount] = {"walls", "stone",   "glass", "frames",
                                         "roof",  "awnings", "metal"};
    std::vector<uint32_t> meshes;
    for (int p = 0; p < kPartCount; ++p) {
      if (parts_[p].empty()) continue;
      meshes.push_back(static_cast<uint32_t>(scene.meshes.size()));
      scene.meshes.push_back(parts_[p].ToMesh(name + " " + part_name[p], material[p]));
    }
    return meshes;
  }

 private:
  // Wide windows have wide bays.
  int Bays(double width) const {
    const double bay = s_.tall_windows ? kBay : 1.25 * kBay;
    return std::max(1, static_cast<int>(width / bay + 0.25));
  }
  Solid& wall() { return parts_[kWallPart]; }
  Solid& stone() { return parts_[kStonePart]; }

  // Storeys of windows from `v0` up: full-width bands between rows of piers and openings.
  void StreetFacade(const Facade& f, double width, double v0, int floors, int side) {
    const int bays = Bays(width);
    const double bay = width / bays;
    const double half = s_.tall_windows ? 0.8 : 1.3;
    const double sill = s_.tall_windows ? 0.35 : 0.95;
    const double head = s_.tall_windows ? 2.85 : 2.75;
    const double base = v0 == 0 ? kGroundHeight : v0;
    double band_bottom = base;
    for (int floor = 0; floor < floors; ++floor) {
      const double v = base + floor * kFloorHeight;
      Panel(wall(), f, 0, band_bottom, width, v + sill);
      band_bottom = v + head;
      double pier_begin = 0;
      for (int b = 0; b < bays; ++b) {
        const double center = (b + 0.5) * bay;
        Panel(wall(), f, pier_begin, v + sill, center - half, v + head);
        pier_begin = center + half;
        Window(f, center, half, v + sill, v + head);
        const bool balcony = s_.balconies && floor > 0 && (b + floor) % 2 == side;
        if (balcony) Balcony(f, center, v + sill);
      }
      Panel(wall(), f, pier_begin, v + sill, width, v + head);
    }
    const double top = base + floors * kFloorHeight;
    Panel(wall(), f, 0, band_bottom, width, top);
    if (floors > 0 && v0 == 0) Ledge(stone(), f, 0, base - 0.02, width, base + 0.28, 0.16);
    if (floors > 3) Ledge(stone(), f, 0, top - kFloorHeight - 0.2, width, top - kFloorHeight, 0.1);
    Ledge(stone(), f, -0.45, top - 0.45, width, top - 0.12, 0.45);
    Ledge(stone(), f, -0.2, top - 0.7, width, top - 0.45, 0.2);
  }

  void Window(const Facade& f, double center, double half, double v0, double v1) {
    constexpr double kRecess = 0.28, kOut = 0.12;
    const double u0 = center - half, u1 = center + half, d = -kRecess;
    stone().Quad(f.At(u0, v1, d), f.At(u1, v1, d), f.At(u1, v1), f.At(u0, v1));
    stone().Quad(f.At(u0, v0, d), f.At(u0, v1, d), f.At(u0, v1), f.At(u0, v0));
    stone().Quad(f.At(u1, v0), f.At(u1, v1), f.At(u1, v1, d), f.At(u1, v0, d));
    // The sill: its top reaches from the glass to before the wall, its front slopes back.
    stone().Quad(f.At(u0, v0, kOut), f.At(u1, v0, kOut), f.At(u1, v0, d), f.At(u0, v0, d));
    stone().Quad(f.At(u0, v0 - 0.2), f.At(u1, v0 - 0.2), f.At(u1, v0, kOut), f.At(u0, v0, kOut));
    Panel(parts_[kGlassPart], f, u0, v0, u1, v1, d);
    Panel(parts_[kFramePart], f, center - 0.06, v0, center + 0.06, v1, d + 0.04);
  }

  void Balcony(const Facade& f, double center, double v) {
    const Facade slab = f.Moved(center, v - 0.16, 0);
    Ledge(stone(), slab, -1.5, -0.14, 1.5, 0.02, 1.05);
    // The railing: front and sides, seen from both faces.
    Solid& metal = parts_[kMetalPart];
    Panel(metal, slab, -1.45, 0.1, 1.45, 0.95, 1.0);
    metal.Quad(slab.At(-1.45, 0.1), slab.At(-1.45, 0.1, 1), slab.At(-1.45, 0.95, 1),
               slab.At(-1.45, 0.95));
    metal.Quad(slab.At(1.45, 0.1, 1), slab.At(1.45, 0.1), slab.At(1.45, 0.95),
               slab.At(1.45, 0.95, 1));
  }

  void GroundFloor(const Facade& street_z, const Facade& street_x) {
    if (!s_.arcade) {
      ShopFront(street_z, kSide, 0);
      ShopFront(street_x, kSide, 1);
      return;
    }
    Arcade(street_z);
    Arcade(street_x);
    ShopFront(street_z.Moved(0, 0, -kArcadeDepth), kSide - kArcadeDepth, 0);
    ShopFront(street_x.Moved(kArcadeDepth, 0, -kArcadeDepth), kSide - kArcadeDepth, 1);
    // The ceiling, an L.
    const double t = kWallThickness, d = kArcadeDepth, y = kGroundHeight - 0.05;
    wall().Quad({t, y, t}, {kSide, y, t}, {kSide, y, d}, {t, y, d});
    wall().Quad({t, y, d}, {d, y, d}, {d, y, kSide}, {t, y, kSide});
  }

  void ShopFront(const Facade& f, double width, int side) {
    const int bays = Bays(width);
    const double bay = width / bays;
    constexpr double kHead = 3.2, kRecess = 0.35;
    double pier_begin = 0;
    for (int b = 0; b < bays; ++b) {
      const double center = (b + 0.5) * bay;
      const double half = 0.5 * bay - 0.55;
      const bool door = RandomInt(3, s_.seed, kShopChoice, side, b) == 0;
      const double sill = door ? kKerbHeight : 0.7;
      Panel(wall(), f, pier_begin, 0, center - half, kHead);
      if (!door) Panel(stone(), f, center - half, 0, center + half, sill);
      pier_begin = center + half;
      Reveal(stone(), f, center - half, sill, center + half, kHead, kRecess);
      Panel(parts_[kGlassPart], f, center - half, sill, center + half, kHead, -kRecess);
      Panel(parts_[kFramePart], f, center - half, kHead - 0.75, center + half, kHead - 0.65,
            -kRecess + 0.05);
      if (!s_.arcade && RandomInt(5, s_.seed, kAccentChoice, side, b) < 3) {
        Awning(f, center, half + 0.15, kHead - 0.1);
      }
    }
    Panel(wall(), f, pier_begin, 0, width, kHead);
    Panel(wall(), f, 0, kHead, width, kGroundHeight);
    Ledge(parts_[kAccentPart], f, 0.3, kHead + 0.25, width - 0.3, kHead + 0.75, 0.08);
  }

  void Awning(const Facade& f, double center, double half, double v) {
    Solid& cloth = parts_[kAccentPart];
    const Facade a = f.Moved(center, v, 0.02);
    cloth.Quad(a.At(-half, -0.55, 1.3), a.At(half, -0.55, 1.3), a.At(half, 0), a.At(-half, 0));
    Panel(cloth, a, -half, -0.8, half, -0.55, 1.3);
    cloth.Triangle(a.At(-half, -0.55), a.At(-half, -0.55, 1.3), a.At(-half, 0));
    cloth.Triangle(a.At(half, -0.55, 1.3), a.At(half, -0.55), a.At(half, 0));
  }

  // Pillars and arches; the wall is kWallThickness deep.
  void Arcade(const Facade& f) {
    constexpr double kPillarHalf = 0.45, kSpring = 2.5, kRise = 1.3;
    constexpr int kSegments = 6;
    const int bays = Bays(kSide);
    const double bay = kSide / bays, top = kGroundHeight, back = -kWallThickness;
    for (int b = 0; b <= bays; ++b) {
      const double u0 = b == 0 ? 0 : b * bay - kPillarHalf;
      const double u1 = b == bays ? kSide : b * bay + kPillarHalf;
      Panel(wall(), f, u0, 0, u1, top);
      wall().Quad(f.At(u1, 0, back), f.At(u0, 0, back), f.At(u0, top, back), f.At(u1, top, back));
    }
    for (int b = 0; b < bays; ++b) {
      const double u0 = b * bay + kPillarHalf, u1 = (b + 1) * bay - kPillarHalf;
      const double center = 0.5 * (u0 + u1), radius = 0.5 * (u1 - u0);
      wall().Quad(f.At(u0, 0, back), f.At(u0, kSpring, back), f.At(u0, kSpring), f.At(u0, 0));
      wall().Quad(f.At(u1, 0), f.At(u1, kSpring), f.At(u1, kSpring, back), f.At(u1, 0, back));
      for (int k = 0; k < kSegments; ++k) {
        const SinCos a0 = DetSinCos(kPi * (kSegments - k) / kSegments);
        const SinCos a1 = DetSinCos(kPi * (kSegments - k - 1) / kSegments);
        const double x0 = center + radius * a0.cos, y0 = kSpring + kRise * a0.sin;
        const double x1 = center + radius * a1.cos, y1 = kSpring + kRise * a1.sin;
        wall().Quad(f.At(x0, y0), f.At(x1, y1), f.At(x1, top), f.At(x0, top));
        wall().Quad(f.At(x1, y1, back), f.At(x0, y0, back), f.At(x0, top, back),
                    f.At(x1, top, back));
        stone().Quad(f.At(x0, y0, back), f.At(x1, y1, back), f.At(x1, y1), f.At(x0, y0));
      }
    }
  }

  // The walls towards the neighbours and the courtyard, of an L with street corner (a, a).
  void Backs(double a, double side, double depth, double v0, double v1) {
    Solid& w = wall();
    w.Quad({side, v0, depth}, {side, v0, a}, {side, v1, a}, {side, v1, depth});
    w.Quad({a, v0, side}, {depth, v0, side}, {depth, v1, side}, {a, v1, side});
    const Facade yard_z{{depth, 0, depth}, {1, 0, 0}, {0, 0, 1}};
    const Facade yard_x{{depth, 0, side}, {0, 0, -1}, {1, 0, 0}};
    for (const Facade& f : {yard_z, yard_x}) {
      const double width = side - depth;
      Panel(w, f, 0, v0, width, v1);
      for (double v = std::max(v0, kGroundHeight); v + kFloorHeight <= v1 + 0.01;
           v += kFloorHeight) {
        for (int b = 0; b < 2; ++b) {
          const double center = (b + 0.5) * width / 2;
          Panel(parts_[kGlassPart], f, center - 0.9, v + 0.9, center + 0.9, v + 2.5, 0.03);
        }
      }
    }
  }

  // A flat L-shaped roof with its parapet.
  void RoofDeck(double a, double side, double depth, double y, bool with_parapet = true) {
    Solid& roof = parts_[kRoofPart];
    roof.Quad({a, y, a}, {a, y, depth}, {side, y, depth}, {side, y, a});
    roof.Quad({a, y, depth}, {a, y, side}, {depth, y, side}, {depth, y, depth});
    const double h = with_parapet ? 0.9 : 0.5, t = 0.3;
    wall().Box({a, y, a}, {side, y + h, a + t});
    wall().Box({a, y, a + t}, {a + t, y + h, side});
    wall().Box({side - t, y, a + t}, {side, y + h, depth});
    wall().Box({a + t, y, side - t}, {depth, y + h, side});
    wall().Box({depth - t, y, depth}, {depth, y + h, side - t});
    wall().Box({depth, y, depth - t}, {side - t, y + h, depth});
  }

  void UpperStoreys(double base) {
    constexpr double kInset = 2.4;
    const int floors = s_.floors - s_.setback;
    const Facade street_z{{kSide, 0, kInset}, {-1, 0, 0}, {0, 0, -1}};
    const Facade street_x{{kInset, 0, kInset}, {0, 0, 1}, {-1, 0, 0}};
    StreetFacade(street_z, kSide - kInset, base, floors, 0);
    StreetFacade(street_x, kSide - kInset, base, floors, 1);
    const double top = base + floors * kFloorHeight;
    Backs(kInset, kSide, kDepth, base, top);
    RoofDeck(kInset, kSide, kDepth, top);
    RoofObjects(kInset, top);
  }

  void Roof(double eaves) {
    if (!s_.mansard) {
      RoofDeck(0, kSide, kDepth, eaves);
      RoofObjects(0, eaves);
      return;
    }
    // Slopes all round, then a flat top.
    constexpr double kIn = 2.2, kUp = 3.0;
    const double top = eaves + kUp;
    Solid& roof = parts_[kRoofPart];
    const Vec3d outer[6] = {{0, eaves, 0},           {0, eaves, kSide},      {kDepth, eaves, kSide},
                            {kDepth, eaves, kDepth}, {kSide, eaves, kDepth}, {kSide, eaves, 0}};
    const Vec3d inner[6] = {{kIn, top, kIn},
                            {kIn, top, kSide - kIn},
                            {kDepth - kIn, top, kSide - kIn},
                            {kDepth - kIn, top, kDepth - kIn},
                            {kSide - kIn, top, kDepth - kIn},
                            {kSide - kIn, top, kIn}};
    for (int i = 0; i < 6; ++i) {
      const int j = (i + 1) % 6;
      roof.Quad(outer[i], outer[j], inner[j], inner[i]);
    }
    roof.Quad(inner[0], {kIn, top, kDepth - kIn}, inner[4], inner[5]);
    roof.Quad({kIn, top, kDepth - kIn}, inner[1], inner[2], inner[3]);
    const Facade street_z{{kSide, 0, 0}, {-1, 0, 0}, {0, 0, -1}};
    const Facade street_x{{0, 0, 0}, {0, 0, 1}, {-1, 0, 0}};
    for (const Facade& f : {street_z, street_x}) {
      const int bays = Bays(kSide);
      for (int b = 0; b < bays; ++b) Dormer(f.Moved((b + 0.5) * kSide / bays, eaves, -0.35));
    }
    for (int c = 0; c < 2; ++c) {
      const double x = c == 0 ? kSide - 3.5 : 5.5, z = c == 0 ? 5.0 : kSide - 3.5;
      wall().Box({x - 0.9, top - 0.2, z - 0.5}, {x + 0.9, top + 1.6, z + 0.5});
    }
  }

  void Dormer(const Facade& f) {
    constexpr double kHalf = 0.75, kHeight = 1.9;
    Solid& roof = parts_[kRoofPart];
    // Back to where the slope has risen to the dormer's top.
    const double back = -(2.2 / 3.0) * kHeight - 0.1;
    Panel(stone(), f, -kHalf, 0, -kHalf + 0.15, kHeight);
    Panel(stone(), f, kHalf - 0.15, 0, kHalf, kHeight);
    Panel(stone(), f, -kHalf + 0.15, kHeight - 0.25, kHalf - 0.15, kHeight);
    Panel(stone(), f, -kHalf + 0.15, 0, kHalf - 0.15, 0.4);
    Reveal(stone(), f, -kHalf + 0.15, 0.4, kHalf - 0.15, kHeight - 0.25, 0.12);
    Panel(parts_[kGlassPart], f, -kHalf + 0.15, 0.4, kHalf - 0.15, kHeight - 0.25, -0.12);
    roof.Quad(f.At(-kHalf, 0, back), f.At(-kHalf, 0), f.At(-kHalf, kHeight),
              f.At(-kHalf, kHeight, back));
    roof.Quad(f.At(kHalf, 0), f.At(kHalf, 0, back), f.At(kHalf, kHeight, back),
              f.At(kHalf, kHeight));
    roof.Quad(f.At(-kHalf - 0.1, kHeight, 0.1), f.At(kHalf + 0.1, kHeight, 0.1),
              f.At(kHalf + 0.1, kHeight + 0.1, back), f.At(-kHalf - 0.1, kHeight + 0.1, back));
  }

  void RoofObjects(double a, double y) {
    // The stair's head.
    const double x = a + 5 + 4 * Random(s_.seed, kRoofObjectChoice, 0);
    wall().Box({x, y, 5.5}, {x + 3.2, y + 2.5, 9});
    parts_[kRoofPart].Box({x - 0.15, y + 2.5, 5.35}, {x + 3.35, y + 2.7, 9.15}, true);
    for (int i = 0; i < 4; ++i) {
      const double along = a + 3.5 + 4.2 * i + 1.5 * Random(s_.seed, kRoofObjectChoice, 1, i);
      const double across = a + 2 + 2 * Random(s_.seed, kRoofObjectChoice, 2, i);
      if (Random(s_.seed, kRoofObjectChoice, 3, i) < 0.4) continue;
      // Ventilation, along one wing or the other.
      const bool wing = i % 2 == 0;
      const Vec3d p = wing ? Vec3d(along, y, across) : Vec3d(across, y, along);
      parts_[kMetalPart].Box(p, p + Vec3d(1.3, 0.8 + 0.5 * Random(s_.seed, 4, i), 1.1));
    }
    if (RandomInt(3, s_.seed, kRoofObjectChoice, 5) == 0) {
      // A water tank on legs.
      const Vec3d c(a + 5.5, 0, 17);
      Solid& metal = parts_[kMetalPart];
      for (int leg = 0; leg < 4; ++leg) {
        const Vec3d p = c + Vec3d(leg % 2 == 0 ? -1.1 : 1.0, y, leg / 2 == 0 ? -1.1 : 1.0);
        metal.Box(p, p + Vec3d(0.12, 2.0, 0.12));
      }
      wall().Prism(c, 10, 1.6, y + 2, 1.6, y + 4.6);
      parts_[kRoofPart].Prism(c, 10, 1.75, y + 4.6, 0, y + 5.6);
    }
  }

  BuildingStyle s_;
  std::array<Solid, kPartCount> parts_;
};

BuildingStyle StyleOf(uint64_t seed, int variant, int variants) {
  BuildingStyle s{};
  s.seed = HashKey(seed, kVariantChoice, static_cast<uint64_t>(variant));
  s.wall = (variant * 7 + RandomInt(3, s.seed, kWallChoice)) % kWallColors;
  s.accent = RandomInt(kAccentColors, s.seed, kAccentChoice);
  s.floors = 2 + RandomInt(3, s.seed, kFloorsChoice);
  s.arcade = variant % 3 == 1;
  s.mansard = variant % 5 < 2;
  s.roof_material = s.mansard ? (variant % 5 == 0 ? kSlate : kTiles) : kRoofFelt;
  s.balconies = variant % 4 == 3;
  s.tall_windows = RandomInt(2, s.seed, kWindowChoice) == 0;
  // The last few of the library are the tall ones of the centre.
  if (variant >= variants - std::max(1, variants / 6)) {
    s.floors = 7 + RandomInt(3, s.seed, kFloorsChoice, 1);
    s.setback = 4 + RandomInt(2, s.seed, kFloorsChoice, 2);
    s.mansard = false;
    s.balconies = false;
    s.roof_material = kRoofFelt;
  }
  return s;
}

// A lump of foliage: an icosahedron, once subdivided if `fine`, whose radius varies by vertex.
// Smooth normals.
void AddLump(Mesh& mesh, const Vec3d& center, const Vec3d& radius, bool fine, uint64_t seed) {
  const double t = 0.5 * (1 + std::sqrt(5.0));
  std::vector<Vec3d> p = {{-1, t, 0}, {1, t, 0}, {-1, -t, 0}, {1, -t, 0},
                          {0, -1, t}, {0, 1, t}, {0, -1, -t}, {0, 1, -t},
                          {t, 0, -1}, {t, 0, 1}, {-t, 0, -1}, {-t, 0, 1}};
  constexpr int kFaces[20][3] = {{0, 11, 5}, {0, 5, 1},  {0, 1, 7},   {0, 7, 10}, {0, 10, 11},
                                 {1, 5, 9},  {5, 11, 4}, {11, 10, 2}, {10, 7, 6}, {7, 1, 8},
                                 {3, 9, 4},  {3, 4, 2},  {3, 2, 6},   {3, 6, 8},  {3, 8, 9},
                                 {4, 9, 5},  {2, 4, 11}, {6, 2, 10},  {8, 6, 7},  {9, 8, 1}};
  std::vector<std::array<uint32_t, 3>> triangles;
  std::vector<std::pair<std::pair<int, int>, int>> middles;
  const auto middle = [&](int a, int b) {
    const std::pair<int, int> key = std::minmax(a, b);
    for (const auto& [edge, index] : middles) {
      if (edge == key) return index;
    }
    p.push_back((p[static_cast<size_t>(a)] + p[static_cast<size_t>(b)]) * 0.5);
    middles.push_back({key, static_cast<int>(p.size()) - 1});
    return middles.back().second;
  };
  for (const auto& face : kFaces) {
    const int a = face[0], b = face[1], c = face[2];
    if (!fine) {
      triangles.push_back(
          {static_cast<uint32_t>(a), static_cast<uint32_t>(b), static_cast<uint32_t>(c)});
      continue;
    }
    const int ab = middle(a, b), bc = middle(b, c), ca = middle(c, a);
    for (const auto& f : {std::array<int, 3>{a, ab, ca}, {b, bc, ab}, {c, ca, bc}, {ab, bc, ca}}) {
      triangles.push_back(
          {static_cast<uint32_t>(f[0]), static_cast<uint32_t>(f[1]), static_cast<uint32_t>(f[2])});
    }
  }
  const auto first = static_cast<uint32_t>(mesh.positions.size());
  for (size_t v = 0; v < p.size(); ++v) {
    const double bump = 0.74 + 0.46 * Random(seed, v);
    const Vec3d d = Normalize(p[v]) * bump;
    p[v] = center + Vec3d(d.x * radius.x, d.y * radius.y, d.z * radius.z);
  }
  std::vector<Vec3d> normals(p.size());
  for (const auto& f : triangles) {
    const Vec3d n = Cross(p[f[1]] - p[f[0]], p[f[2]] - p[f[0]]);
    for (const uint32_t v : f) normals[v] += n;
    mesh.triangles.push_back({first + f[0], first + f[1], first + f[2]});
  }
  for (size_t v = 0; v < p.size(); ++v) {
    mesh.positions.emplace_back(Vec3f(p[v]));
    mesh.normals.emplace_back(Vec3f(Normalize(normals[v])));
  }
}

class City {
 public:
  City(unsigned blocks, uint64_t seed)
      : blocks_(static_cast<int>(std::clamp(blocks, 1u, 64u))), seed_(seed) {}

  Scene Build() {
    scene_.name = "city";
    scene_.materials = CityMaterials();
    MakeLibraries();
    Ground();
    Streets();
    for (int j = 0; j < blocks_; ++j) {
      for (int i = 0; i < blocks_; ++i) Block(i, j);
    }
    Lights();
    Cameras();
    return std::move(scene_);
  }

 private:
  // Instanced together.
  struct Model {
    std::string name;
    std::vector<uint32_t> meshes;
  };

  uint32_t AddMesh(Mesh mesh) {
    scene_.meshes.push_back(std::move(mesh));
    return static_cast<uint32_t>(scene_.meshes.size() - 1);
  }
  void Place(const Model& model, const Affine& world_from_model) {
    for (const uint32_t mesh : model.meshes) {
      scene_.instances.push_back({model.name, mesh, world_from_model});
    }
  }
  static Affine At(double x, double y, double z) {
    Affine m;
    m.translation = {x, y, z};
    return m;
  }
  // Turned by quarters about y, exactly.
  static Affine Turned(int quarters, const Vec3d& translation) {
    constexpr double kCos[4] = {1, 0, -1, 0}, kSin[4] = {0, 1, 0, -1};
    const double c = kCos[quarters & 3], s = kSin[quarters & 3];
    Affine m;
    m.column[0] = {c, 0, -s};
    m.column[2] = {s, 0, c};
    m.translation = translation;
    return m;
  }
  // Position of street axis i, of `blocks_` + 1.
  double Street(int i) const { return (i - 0.5 * blocks_) * kPitch; }

  void MakeLibraries() {
    const int variants = std::clamp(blocks_ * blocks_ * 4 / 3, 6, 24);
    for (int v = 0; v < variants; ++v) {
      Building building(StyleOf(seed_, v, variants));
      building.Build();
      const std::string name = "building " + std::to_string(v);
      buildings_.push_back({name, building.AddTo(scene_, name)});
    }
    for (int v = 0; v < 4; ++v) trees_.push_back(Tree(v));
    lamp_ = Lamp();
    MakeCars();
    bench_ = Bench();
    Solid slab, kerb;
    const double in = kKerbHalf - 0.3;
    slab.Quad({-in, kKerbHeight, -in}, {-in, kKerbHeight, in}, {in, kKerbHeight, in},
              {in, kKerbHeight, -in});
    kerb.Box({-kKerbHalf, 0, -kKerbHalf}, {kKerbHalf, kKerbHeight, -in});
    kerb.Box({-kKerbHalf, 0, in}, {kKerbHalf, kKerbHeight, kKerbHalf});
    kerb.Box({-kKerbHalf, 0, -in}, {-in, kKerbHeight, in});
    kerb.Box({in, 0, -in}, {kKerbHalf, kKerbHeight, in});
    slab_ = {"pavement",
             {AddMesh(slab.ToMesh("pavement", kPavement)), AddMesh(kerb.ToMesh("kerb", kKerb))}};
    Solid yard;
    const double y = kKerbHeight + 0.02, h = kSide - kDepth;
    yard.Quad({-h, y, -h}, {-h, y, h}, {h, y, h}, {h, y, -h});
    courtyard_ = {"courtyard", {AddMesh(yard.ToMesh("courtyard", kGravel))}};
    park_ = Park();
    markings_ = Markings();
  }

  Model Tree(int v) {
    const uint64_t seed = HashKey(seed_, kTreeChoice, static_cast<uint64_t>(v));
    Solid trunk;
    const double height = 2.6 + Random(seed, 0);
    trunk.Prism({}, 6, 0.2, 0, 0.12, height + 1);
    Mesh crown;
    crown.name = "crown " + std::to_string(v);
    crown.material = kFirstLeaves + RandomInt(kLeafColors, seed, kLeafChoice);
    AddLump(crown, {0, height + 1.7, 0}, {1.7, 1.9, 1.7}, true, HashKey(seed, 1));
    AddLump(crown, {0.8, height + 2.8, 0.4}, {1.2, 1.3, 1.2}, false, HashKey(seed, 2));
    AddLump(crown, {-0.7, height + 0.9, -0.8}, {1.2, 1.0, 1.2}, false, HashKey(seed, 3));
    const std::string name = "tree " + std::to_string(v);
    return {
        name,
        {AddMesh(trunk.ToMesh("trunk " + std::to_string(v), kBark)), AddMesh(std::move(crown))}};
  }

  // Leans over +x.
  Model Lamp() {
    Solid solid;
    solid.Prism({}, 6, 0.12, 0, 0.06, 5.2);
    solid.Box({-0.05, 5.1, -0.05}, {1.3, 5.2, 0.05}, true);
    Solid head;
    head.Box({0.9, 4.95, -0.14}, {1.5, 5.1, 0.14}, true);
    return {"lamp",
            {AddMesh(solid.ToMesh("lamp post", kDarkMetal)),
             AddMesh(head.ToMesh("lamp head", kFrame))}};
  }

  Model Bench() {
    Solid wood, iron;
    wood.Box({-0.8, 0.42, -0.22}, {0.8, 0.48, 0.22}, true);
    wood.Box({-0.8, 0.62, 0.2}, {0.8, 0.9, 0.25}, true);
    iron.Box({-0.65, 0, -0.18}, {-0.55, 0.42, 0.2});
    iron.Box({0.55, 0, -0.18}, {0.65, 0.42, 0.2});
    return {"bench",
            {AddMesh(wood.ToMesh("bench seat", kBark)),
             AddMesh(iron.ToMesh("bench legs", kDarkMetal))}};
  }

  // A car along z, its front at +z. One set of meshes for each paintwork.
  void MakeCars() {
    Solid body, windows, wheels;
    struct Station {
      double z, y, half;  // along the roof line
    };
    constexpr Station kRoofLine[] = {{-2.05, 0.55, 0.82}, {-2.0, 0.92, 0.84}, {-1.55, 1.0, 0.84},
                                     {-1.05, 1.46, 0.68}, {0.35, 1.48, 0.68}, {1.05, 0.98, 0.84},
                                     {1.95, 0.84, 0.8},   {2.1, 0.5, 0.78}};
    constexpr double kBelly = 0.24, kBelt = 0.95;
    constexpr int kStations = 8;
    for (int i = 0; i + 1 < kStations; ++i) {
      const Station &a = kRoofLine[i], &b = kRoofLine[i + 1];
      const bool screen = i == 2 || i == 4;
      (screen ? windows : body)
          .Quad({-a.half, a.y, a.z}, {-b.half, b.y, b.z}, {b.half, b.y, b.z}, {a.half, a.y, a.z});
      const double ya = std::min(a.y, kBelt), yb = std::min(b.y, kBelt);
      const double wa = a.y > kBelt ? 0.84 : a.half, wb = b.y > kBelt ? 0.84 : b.half;
      for (const double s : {-1.0, 1.0}) {
        const Vec3d la(s * wa, kBelly, a.z), lb(s * wb, kBelly, b.z);
        const Vec3d ua(s * wa, ya, a.z), ub(s * wb, yb, b.z);
        s < 0 ? body.Quad(la, lb, ub, ua) : body.Quad(lb, la, ua, ub);
        if (a.y > kBelt || b.y > kBelt) {
          const Vec3d ra(s * a.half, a.y, a.z), rb(s * b.half, b.y, b.z);
          if (a.y <= kBelt) {
            s < 0 ? windows.Triangle(ua, ub, rb) : windows.Triangle(ub, ua, rb);
          } else if (b.y <= kBelt) {
            s < 0 ? windows.Triangle(ua, ub, ra) : windows.Triangle(ub, ua, ra);
          } else {
            s < 0 ? windows.Quad(ua, ub, rb, ra) : windows.Quad(ub, ua, ra, rb);
          }
        }
      }
    }
    const Station &rear = kRoofLine[0], &front = kRoofLine[kStations - 1];
    body.Quad({rear.half, kBelly, rear.z}, {-rear.half, kBelly, rear.z},
              {-rear.half, rear.y, rear.z}, {rear.half, rear.y, rear.z});
    body.Quad({-front.half, kBelly, front.z}, {front.half, kBelly, front.z},
              {front.half, front.y, front.z}, {-front.half, front.y, front.z});
    constexpr int kSpokes = 6;
    for (const double x : {-0.87, 0.87}) {
      for (const double z : {-1.3, 1.3}) {
        const auto rim = [&](int k, double inwards) {
          const SinCos a = DetSinCos(2 * kPi * k / kSpokes);
          return Vec3d(x - std::copysign(inwards, x), 0.33 + 0.33 * a.sin, z + 0.33 * a.cos);
        };
        for (int k = 0; k < kSpokes; ++k) {
          const Vec3d hub(x, 0.33, z);
          x < 0 ? wheels.Triangle(hub, rim(k, 0), rim(k + 1, 0))
                : wheels.Triangle(hub, rim(k + 1, 0), rim(k, 0));
          x < 0 ? wheels.Quad(rim(k, 0), rim(k, 0.2), rim(k + 1, 0.2), rim(k + 1, 0))
                : wheels.Quad(rim(k + 1, 0), rim(k + 1, 0.2), rim(k, 0.2), rim(k, 0));
        }
      }
    }
    const uint32_t glass = AddMesh(windows.ToMesh("car windows", kGlass));
    const uint32_t rubber = AddMesh(wheels.ToMesh("car wheels", kRubber));
    for (int c = 0; c < kPaintworks; ++c) {
      const std::string name = "car " + std::to_string(c);
      cars_.push_back(
          {name, {AddMesh(body.ToMesh(name + " body", kFirstPaintwork + c)), glass, rubber}});
    }
  }

  Model Park() {
    const double y = kKerbHeight + 0.03, r = kLotHalf, w = 1.8, c = 5.5;
    Solid grass, gravel, basin, water;
    for (int q = 0; q < 4; ++q) {
      const double sx = q & 1 ? 1 : -1, sz = q & 2 ? 1 : -1;
      const double x0 = std::min(sx * w, sx * r), x1 = std::max(sx * w, sx * r);
      const double z0 = std::min(sz * w, sz * r), z1 = std::max(sz * w, sz * r);
      grass.Box({x0, kKerbHeight, z0}, {x1, y + 0.09, z1});
    }
    gravel.Quad({-w, y, -r}, {-w, y, r}, {w, y, r}, {w, y, -r});
    gravel.Quad({-r, y, -w}, {-r, y, w}, {-w, y, w}, {-w, y, -w});
    gravel.Quad({w, y, -w}, {w, y, w}, {r, y, w}, {r, y, -w});
    gravel.Prism({}, 16, c, y, c - 0.05, y + 0.13);
    basin.Prism({}, 16, 3.2, y, 3.2, y + 0.7);
    water.Prism({}, 16, 2.8, y + 0.6, 2.8, y + 0.72);
    basin.Prism({}, 12, 0.35, y + 0.7, 0.25, y + 1.9);
    basin.Prism({}, 12, 0.4, y + 1.7, 1.1, y + 2.1);
    basin.Prism({}, 12, 0.2, y + 2.1, 0.1, y + 2.9);
    return {"park",
            {AddMesh(grass.ToMesh("lawn", kGrass)), AddMesh(gravel.ToMesh("path", kGravel)),
             AddMesh(basin.ToMesh("fountain", kStone)),
             AddMesh(water.ToMesh("fountain water", kWater))}};
  }

  // Of a street along z, from one crossing to the next: the centre line and two zebra crossings.
  Model Markings() {
    Solid paint;
    const double y = 0.012;
    const auto stripe = [&](double x0, double z0, double x1, double z1) {
      paint.Quad({x0, y, z0}, {x0, y, z1}, {x1, y, z1}, {x1, y, z0});
    };
    for (int i = 0; i < 6; ++i) stripe(-0.08, -18.5 + 6.6 * i, 0.08, -15 + 6.6 * i);
    for (const double z : {-24.5, 21.5}) {
      for (int i = 0; i < 7; ++i) stripe(-4.0 + 1.2 * i, z, -3.4 + 1.2 * i, z + 3.0);
    }
    return {"markings", {AddMesh(paint.ToMesh("markings", kPaint))}};
  }

  void Ground() {
    const double half = 0.5 * blocks_ * kPitch + kMargin;
    const int cells = 2 * blocks_ + 2;
    Mesh mesh;
    mesh.name = "ground";
    mesh.material = kAsphalt;
    for (int j = 0; j <= cells; ++j) {
      for (int i = 0; i <= cells; ++i) {
        mesh.positions.emplace_back(
            Vec3f(Vec3d(-half + 2 * half * i / cells, 0, -half + 2 * half * j / cells)));
      }
    }
    const auto row = static_cast<uint32_t>(cells + 1);
    for (uint32_t j = 0; j + 1 < row; ++j) {
      for (uint32_t i = 0; i + 1 < row; ++i) {
        const uint32_t a = j * row + i;
        mesh.triangles.push_back({a, a + row, a + row + 1});
        mesh.triangles.push_back({a, a + row + 1, a + 1});
      }
    }
    Place({"ground", {AddMesh(std::move(mesh))}}, Affine());
  }

  void Streets() {
    for (int i = 0; i <= blocks_; ++i) {
      for (int j = 0; j < blocks_; ++j) {
        const double along = Street(j) + 0.5 * kPitch;
        Place(markings_, Turned(0, {Street(i), 0, along}));
        Place(markings_, Turned(1, {along, 0, Street(i)}));
        ParkCars(i, j, 0);
        ParkCars(i, j, 1);
      }
    }
  }

  void ParkCars(int i, int j, int direction) {
    for (int slot = 0; slot < 6; ++slot) {
      const uint64_t key =
          HashKey(seed_, kCarChoice, static_cast<uint64_t>(i), static_cast<uint64_t>(j),
                  static_cast<uint64_t>(direction), static_cast<uint64_t>(slot));
      if (Random(key, 0) > 0.19) continue;
      const double side = slot % 2 == 0 ? -1 : 1;
      const double along =
          Street(j) + 0.5 * kPitch - 13 + 13 * (slot / 2) + 4 * (Random(key, 1) - 0.5);
      const double across = Street(i) + side * 3.35;
      const Model& car = cars_[static_cast<size_t>(RandomInt(kPaintworks, key, 2))];
      const int facing = side > 0 ? 2 : 0;
      Place(car, direction == 0 ? Turned(facing, {across, 0, along})
                                : Turned(facing + 1, {along, 0, across}));
    }
  }

  bool IsPark(int i, int j) const {
    if (blocks_ < 2) return false;
    return Random(seed_, kParkChoice, i, j) < 0.09 ||
           (blocks_ >= 4 && i == blocks_ / 2 && j == blocks_ / 2 - 1);
  }

  void Block(int i, int j) {
    const Vec3d center(Street(i) + 0.5 * kPitch, 0, Street(j) + 0.5 * kPitch);
    Place(slab_, At(center.x, 0, center.z));
    const bool park = IsPark(i, j);
    if (park) {
      Place(park_, At(center.x, 0, center.z));
    } else {
      Place(courtyard_, At(center.x, 0, center.z));
      for (int corner = 0; corner < 4; ++corner) PlaceBuilding(i, j, corner, center);
    }
    Greenery(i, j, park, center);
  }

  // Turns the lot's frame, whose origin is the street corner, to the block's corner.
  void PlaceBuilding(int i, int j, int corner, const Vec3d& center) {
    const uint64_t key = HashKey(seed_, kVariantChoice, static_cast<uint64_t>(i),
                                 static_cast<uint64_t>(j), static_cast<uint64_t>(corner));
    const int count = static_cast<int>(buildings_.size());
    const int tall = std::max(1, count / 6);
    // Tall buildings gather in the middle of the city.
    const double x = center.x / (0.5 * kPitch * blocks_), z = center.z / (0.5 * kPitch * blocks_);
    const bool high = Random(key, 1) < 0.36 * (1 - std::min(1.0, std::sqrt(x * x + z * z)));
    // Neighbours differ: the corner enters the choice.
    const int low = (RandomInt(count - tall, key, 2) / 4 * 4 + corner) % (count - tall);
    const int variant = high ? count - tall + RandomInt(tall, key, 3) : low;
    constexpr double kCornerX[4] = {-1, -1, 1, 1}, kCornerZ[4] = {-1, 1, 1, -1};
    Affine world_from_lot = Turned(corner, {center.x + kCornerX[corner] * kLotHalf, 0,
                                            center.z + kCornerZ[corner] * kLotHalf});
    if (RandomInt(2, key, kMirrorChoice) == 1)
      std::swap(world_from_lot.column[0], world_from_lot.column[2]);
    Place(buildings_[static_cast<size_t>(variant)], world_from_lot);
  }

  void PlaceTree(uint64_t key, double x, double y, double z) {
    const SinCos turn = DetSinCos(2 * kPi * Random(key, 1));
    const double scale = 0.85 + 0.4 * Random(key, 2);
    Affine m;
    m.column[0] = Vec3d(turn.cos, 0, -turn.sin) * scale;
    m.column[1] = Vec3d(0, 1, 0) * scale;
    m.column[2] = Vec3d(turn.sin, 0, turn.cos) * scale;
    m.translation = {x, y, z};
    Place(trees_[static_cast<size_t>(RandomInt(static_cast<int>(trees_.size()), key, 3))], m);
  }

  void Greenery(int i, int j, bool park, const Vec3d& center) {
    for (int side = 0; side < 4; ++side) {
      const Affine world_from_side = Turned(side, center);
      for (int slot = 0; slot < 4; ++slot) {
        const uint64_t key =
            HashKey(seed_, kTreeChoice, static_cast<uint64_t>(i), static_cast<uint64_t>(j),
                    static_cast<uint64_t>(side), static_cast<uint64_t>(slot));
        const Vec3d p = world_from_side.Point({-16.5 + 11 * slot, kKerbHeight, -kKerbHalf + 0.9});
        if (Random(key, 0) < 0.27) PlaceTree(key, p.x, p.y, p.z);
      }
      if (side % 2 == (i + j) % 2) continue;
      const Vec3d lamp =
          world_from_side.Point({-11.0 + 22 * (side % 2), kKerbHeight, -kKerbHalf + 0.6});
      Place(lamp_, Turned(side + 1, lamp));
    }
    if (!park) return;
    for (int t = 0; t < 16; ++t) {
      const uint64_t key = HashKey(seed_, kTreeChoice, static_cast<uint64_t>(i),
                                   static_cast<uint64_t>(j), static_cast<uint64_t>(100 + t));
      const double sx = t & 1 ? 1 : -1, sz = t & 2 ? 1 : -1;
      const double x = sx * (4.5 + 15 * Random(key, 4)), z = sz * (4.5 + 15 * Random(key, 5));
      PlaceTree(key, center.x + x, kKerbHeight + 0.1, center.z + z);
    }
    for (int b = 0; b < 8; ++b) {
      const double s = b & 4 ? 1 : -1;
      const Vec3d p = Turned(b, center).Point({s * 1.35, kKerbHeight + 0.03, -12});
      Place(bench_, Turned(b + (s > 0 ? 1 : 3), p));
    }
  }

  void Lights() {
    PunctualLight sun;
    sun.name = "sun";
    sun.kind = PunctualKind::kDirectional;
    sun.direction = Normalize(Vec3d(0.55, -0.78, -0.42));
    sun.intensity = {3.3f, 2.95f, 2.4f};
    scene_.lights.push_back(sun);
    scene_.environment.sky = {0.3f, 0.39f, 0.55f};
  }

  static Camera LookAt(const char* name, const Vec3d& eye, const Vec3d& target, double yfov_rad) {
    Camera camera;
    camera.name = name;
    camera.eye = eye;
    camera.forward = Normalize(target - eye);
    camera.right = Normalize(Cross(camera.forward, Vec3d(0, 1, 0)));
    camera.up = Cross(camera.right, camera.forward);
    camera.yfov_rad = yfov_rad;
    return camera;
  }

  void Cameras() {
    // At eye level in the street that runs past the park, looking towards -z.
    const double street = Street(blocks_ / 2);
    const double crossing = Street(blocks_ / 2);
    const Vec3d eye(street - 1.5, 2.2, crossing + (blocks_ < 4 ? 27 : -20));
    scene_.cameras.push_back(LookAt("street", eye, eye + Vec3d(9.5, 2.8, -40), 0.95));
    const double half = 0.5 * kPitch * blocks_;
    scene_.cameras.push_back(LookAt("aerial", {-0.8 * half, 30 + 0.55 * half, half},
                                    {0.05 * half, -0.1 * half, -0.05 * half}, 0.75));
  }

  int blocks_;
  uint64_t seed_;
  Scene scene_;
  std::vector<Model> buildings_, trees_, cars_;
  Model lamp_, bench_, slab_, courtyard_, park_, markings_;
};

}  // namespace

Scene MakeCity(unsigned blocks, uint64_t seed) { return City(blocks, seed).Build(); }

}  // namespace farpoint
