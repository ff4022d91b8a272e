#include "core/light/light_sampler.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <span>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/math/simd8.h"

namespace farpoint {

namespace {

// glTF (KHR_lights_punctual): 1 inside the inner cone, 0 outside the outer, squared in between.
float SpotFalloff(const PreparedLight& light, float cos_angle) {
  if (cos_angle <= light.cos_outer) return 0.0f;
  if (cos_angle >= light.cos_inner) return 1.0f;
  const float f = (cos_angle - light.cos_outer) / (light.cos_inner - light.cos_outer);
  return f * f;
}

float RangeWindow(const PreparedLight& light, float d_m) {
  if (light.range_m <= 0.0f) return 1.0f;
  const float q = d_m / light.range_m;
  const float q2 = q * q;
  return std::clamp(1.0f - q2 * q2, 0.0f, 1.0f);
}

// A triangle that fills less than this is sampled by area: its solid angle, a difference of
// angles, would lose its digits, and over so little the two densities are the same.
constexpr double kSmallSolidAngle = 1e-3;

// [0, 1) -> [0, 1] by the density that goes from f0 to f1 (> 0), by which `pdf` is multiplied.
double SampleLinear(double u, double f0, double f1, double& pdf) {
  const double x =
      std::min(u * (f0 + f1) / (f0 + std::sqrt(f0 * f0 + u * (f1 * f1 - f0 * f0))), 1.0);
  pdf *= 2.0 * (f0 + (f1 - f0) * x) / (f0 + f1);
  return x;
}

// The least power of a light beside one of power 1 that keeps it a normal number.
constexpr float kLeastPower = 0x1p-100f;

float InversePowerOfTwo(float x) {
  int exponent = 0;
  std::frexp(x, &exponent);
  return std::ldexp(1.0f, std::clamp(-exponent, -126, 126));
}

}  // namespace

// By solid angle (Arvo 1995, "Stratified Sampling of Spherical Triangles"): bounded however near
// the emitter comes, where sampling by area has the unbounded factor cosθ_l / d².
std::optional<LightSampler::EmitterPoint> LightSampler::SamplePoint(const Emitter& e,
                                                                    const Vec3f& p, const Vec3f& n,
                                                                    float u, float v) const {
  const Vec3d origin(p);
  const Vec3d corner[3] = {Vec3d(e.v0) - origin, Vec3d(e.v0 + e.e1) - origin,
                           Vec3d(e.v0 + e.e2) - origin};
  const double length[3] = {Length(corner[0]), Length(corner[1]), Length(corner[2])};
  const double height = Dot(corner[0], Vec3d(e.normal));  // of the plane over p, signed
  if (!(length[0] > 0) || !(length[1] > 0) || !(length[2] > 0) || height == 0.0) {
    return std::nullopt;  // at a corner, or in the triangle's plane: nothing arrives
  }
  const Vec3d a = corner[0] / length[0], b = corner[1] / length[1], c = corner[2] / length[2];
  const double triple = std::fabs(Dot(a, Cross(b, c)));
  const double solid_angle = 2.0 * DetAtan2(triple, 1.0 + Dot(a, b) + Dot(b, c) + Dot(c, a));
  EmitterPoint out;
  out.height_m = static_cast<float>(std::fabs(height));
  if (!(solid_angle > kSmallSolidAngle)) {
    const Vec2f bary = UniformTriangle(u, v);
    const Vec3d q = corner[0] + Vec3d(e.e1) * static_cast<double>(bary.x) +
                    Vec3d(e.e2) * static_cast<double>(bary.y);
    const double d2 = Length2(q), d = std::sqrt(d2);
    if (!(d > 0)) return std::nullopt;
    out.direction = Vec3f(q / d);
    out.distance_m = static_cast<float>(d);
    out.b1 = bary.x;
    out.b2 = bary.y;
    out.inverse_pdf_sr =
        static_cast<float>(std::fabs(Dot(q, Vec3d(e.normal))) / (d * d2) * e.area_m2);
    return out;
  }
  // (u, v) = (., 0), (0, 1), (1, 1) become b, a, c below: the corners' cosines make a bilinear
  // density over the square that is near to the cosine (Hart et al. 2020, "Practical Product
  // Sampling by Fitting and Composing Warps").
  const Vec3d normal(n);
  constexpr double kLeastCosine = 0.01;
  const double cos_a = std::max(Dot(normal, a), kLeastCosine);
  const double cos_b = std::max(Dot(normal, b), kLeastCosine);
  const double cos_corner_c = std::max(Dot(normal, c), kLeastCosine);
  double warp_pdf = 1.0;
  const double warped_v = SampleLinear(v, 2.0 * cos_b, cos_a + cos_corner_c, warp_pdf);
  const double warped_u = SampleLinear(u, cos_b + (cos_a - cos_b) * warped_v,
                                       cos_b + (cos_corner_c - cos_b) * warped_v, warp_pdf);
  // Interior angles at the corners, from the planes of the great circles.
  const Vec3d n_ab = Cross(a, b), n_ca = Cross(c, a);
  const auto angle = [](const Vec3d& m, const Vec3d& n) {
    return DetAtan2(Length(Cross(m, n)), -Dot(m, n));
  };
  const double alpha = angle(n_ab, n_ca);
  const double cos_alpha = DetSinCos(alpha).cos, sin_alpha = DetSinCos(alpha).sin;
  const double cos_c = Dot(a, b);  // arc opposite to corner c
  // The sub-triangle of area u Ω: its third corner lies on the arc from a to c.
  const SinCos phi = DetSinCos(warped_u * solid_angle - alpha);
  const double uu = phi.cos - cos_alpha;
  const double vv = phi.sin + sin_alpha * cos_c;
  const double denominator = (vv * phi.sin + uu * phi.cos) * sin_alpha;
  const double q =
      denominator != 0.0
          ? std::clamp(((vv * phi.cos - uu * phi.sin) * cos_alpha - vv) / denominator, -1.0, 1.0)
          : 1.0;
  const Vec3d toward_c = NormalizeOr(c - a * Dot(c, a), a);
  const Vec3d c_hat = a * q + toward_c * std::sqrt(std::max(0.0, 1.0 - q * q));
  const double z = 1.0 - warped_v * (1.0 - Dot(c_hat, b));
  const Vec3d w = Normalize(b * z + NormalizeOr(c_hat - b * Dot(c_hat, b), c_hat) *
                                        std::sqrt(std::max(0.0, 1.0 - z * z)));
  // Where the direction meets the triangle's plane.
  const double cos_l = Dot(w, Vec3d(e.normal));
  if (!(cos_l * height > 0.0)) return std::nullopt;
  const double distance = height / cos_l;
  const Vec3d at = w * distance - corner[0];
  const Vec3d e1(e.e1), e2(e.e2);
  const double d11 = Dot(e1, e1), d12 = Dot(e1, e2), d22 = Dot(e2, e2);
  const double det = d11 * d22 - d12 * d12;
  if (!(det > 0.0)) return std::nullopt;
  out.b1 = static_cast<float>(std::clamp((Dot(at, e1) * d22 - Dot(at, e2) * d12) / det, 0.0, 1.0));
  out.b2 = static_cast<float>(std::clamp((Dot(at, e2) * d11 - Dot(at, e1) * d12) / det, 0.0, 1.0));
  out.direction = Vec3f(w);
  out.distance_m = static_cast<float>(distance);
  out.inverse_pdf_sr = static_cast<float>(solid_angle / warp_pdf);
  return out;
}

LightSampler::LightSampler(std::shared_ptr<const RayAccel> accel) : accel_(std::move(accel)) {
  const PreparedScene& scene = accel_->scene();
  AddEmitters();
  AddPunctualLights();
  if (scene.has_environment_map()) environment_ = std::make_unique<EnvironmentSampler>(scene);
  has_sky_ = scene.has_environment_map() || MaxComponent(scene.sky()) > 0.0f;
  any_light_ =
      has_sky_ || !directional_lights_.empty() || !positioned_lights_.empty() || !emitters_.empty();
}

void LightSampler::AddEmitters() {
  const PreparedScene& scene = accel_->scene();
  std::vector<Emitter> found;
  std::vector<float> luminance;
  float brightest = 0;
  for (const uint32_t t : scene.emissive_triangles()) {
    const PreparedMaterial& material = scene.MaterialOf(t);
    const float mean = Luminance(scene.MeanEmission(t));
    if (!(mean > 0.0f)) continue;
    Emitter e;
    e.triangle = t;
    e.v0 = scene.PointOn(t, 0, 0);
    e.e1 = scene.vertices()[scene.triangles()[t].vertex[1]] - e.v0;
    e.e2 = scene.vertices()[scene.triangles()[t].vertex[2]] - e.v0;
    e.normal = scene.GeometricNormal(t);
    e.area_m2 = scene.TriangleArea(t);
    e.varies = material.emission_texture >= 0 || material.alpha_cutoff >= 0.0f;
    found.push_back(e);
    luminance.push_back(mean);
    brightest = std::max(brightest, mean);
  }
  if (found.empty()) return;
  // A power of two, so that weights are near 1 whatever the unit of radiance.
  const float scale = InversePowerOfTwo(brightest);
  std::vector<LightBounds> bounds(found.size());
  for (size_t i = 0; i < found.size(); ++i) {
    const Emitter& e = found[i];
    luminance[i] = std::max(luminance[i] * scale, kLeastPower);
    for (const uint32_t v : scene.triangles()[e.triangle].vertex) {
      bounds[i].box.Extend(scene.vertices()[v]);
    }
    bounds[i].axis = e.normal;
    bounds[i].cos_cone = 1;
    bounds[i].power = e.area_m2 * luminance[i];
  }
  emitter_tree_ = LightTree(bounds, LightTree::Emission::kTwoSidedCosine);
  const std::span<const uint32_t> order = emitter_tree_.order();
  emitters_.resize(order.size());
  emitter_blocks_.resize(order.size() / LightTree::kWidth);
  for (size_t i = 0; i < order.size(); ++i) {
    if (order[i] == LightTree::kNone) continue;
    const Emitter& e = found[order[i]];
    emitters_[i] = e;
    EmitterBlock& block = emitter_blocks_[i / LightTree::kWidth];
    const size_t k = i % LightTree::kWidth;
    const auto& v = scene.triangles()[e.triangle].vertex;
    for (int c = 0; c < 3; ++c) {
      block.a[c][k] = scene.vertices()[v[0]][c];
      block.b[c][k] = scene.vertices()[v[1]][c];
      block.c[c][k] = scene.vertices()[v[2]][c];
      block.normal[c][k] = e.normal[c];
    }
    block.twice_area[k] = 2.0f * e.area_m2;
    block.luminance[k] = luminance[order[i]];
  }
}

void LightSampler::AddPunctualLights() {
  const PreparedScene& scene = accel_->scene();
  std::vector<PreparedLight> found;
  float brightest = 0;
  for (const PreparedLight& light : scene.lights()) {
    if (!(MaxComponent(light.intensity) > 0.0f)) continue;
    if (light.kind == static_cast<uint32_t>(PunctualKind::kDirectional)) {
      directional_lights_.push_back(light);
    } else {
      found.push_back(light);
      brightest = std::max(brightest, Luminance(light.intensity));
    }
  }
  if (found.empty()) return;
  const float scale = InversePowerOfTwo(brightest);
  std::vector<LightBounds> bounds(found.size());
  for (size_t i = 0; i < found.size(); ++i) {
    const PreparedLight& light = found[i];
    bounds[i].box.Extend(light.position);
    if (light.kind == static_cast<uint32_t>(PunctualKind::kSpot)) {
      bounds[i].axis = light.direction;
      bounds[i].cos_cone = std::max(-1.0f, light.cos_outer - 1e-5f);
    }
    bounds[i].power = std::max(Luminance(light.intensity) * scale, kLeastPower);
    if (light.range_m > 0.0f) bounds[i].reach_m = light.range_m;
  }
  punctual_tree_ = LightTree(bounds, LightTree::Emission::kCone);
  const std::span<const uint32_t> order = punctual_tree_.order();
  positioned_lights_.resize(order.size());
  punctual_blocks_.resize(order.size() / LightTree::kWidth);
  for (size_t i = 0; i < order.size(); ++i) {
    PunctualBlock& block = punctual_blocks_[i / LightTree::kWidth];
    const size_t k = i % LightTree::kWidth;
    block.range[k] = 1;
    if (order[i] == LightTree::kNone) continue;
    const PreparedLight& light = found[order[i]];
    positioned_lights_[i] = light;
    for (int c = 0; c < 3; ++c) {
      block.position[c][k] = light.position[c];
      block.direction[c][k] = light.direction[c];
    }
    block.luminance[k] = bounds[order[i]].power;
    // Of point lights everything lies within both cones.
    const bool spot = light.kind == static_cast<uint32_t>(PunctualKind::kSpot);
    block.cos_inner[k] = spot ? light.cos_inner : -2.0f;
    block.cos_outer[k] = spot ? light.cos_outer : -3.0f;
    block.range[k] = light.range_m > 0.0f ? light.range_m : std::numeric_limits<float>::infinity();
  }
  positioned_count_ = static_cast<uint32_t>(found.size());
}

// Luminance times solid angle times the mean of the corners' cosines: near to what arrives if
// nothing is in the way. The solid angle by Van Oosterom and Strackee 1983,
//   tan(Ω/2) = a·(b × c) / (|a||b||c| + a·b |c| + b·c |a| + c·a |b|),
// the arc tangent to 0.5 %. It is 0 only if the triangle lies below the horizon or is seen edge-on.
void LightSampler::Weigh(const EmitterBlock& block, const Vec3f& p, const Vec3f& n,
                         LightTree::Weights& weights) {
  const F8 zero = Set8(0), one = Set8(1), least = Set8(std::numeric_limits<float>::min());
  struct V8 {
    F8 x, y, z;
    F8 Dot(const V8& o) const { return x * o.x + y * o.y + z * o.z; }
  };
  const auto load = [](const LightTree::Weights(&v)[3]) {
    return V8{Load8(v[0].data()), Load8(v[1].data()), Load8(v[2].data())};
  };
  const auto unit = [&](const LightTree::Weights(&v)[3], V8& direction, F8& length) {
    const V8 to{Load8(v[0].data()) - Set8(p.x), Load8(v[1].data()) - Set8(p.y),
                Load8(v[2].data()) - Set8(p.z)};
    length = Sqrt8(to.Dot(to));
    const F8 inverse = one / Max8(length, least);
    direction = {to.x * inverse, to.y * inverse, to.z * inverse};
    return to;
  };
  V8 a, b, c;
  F8 length_a, length_b, length_c;
  const V8 to_a = unit(block.a, a, length_a);
  unit(block.b, b, length_b);
  unit(block.c, c, length_c);
  const F8 height = Abs8(to_a.Dot(load(block.normal)));
  const F8 y = (Load8(block.twice_area.data()) / Max8(length_a * length_b, least)) *
               (height / Max8(length_c, least));
  const F8 x = one + a.Dot(b) + b.Dot(c) + c.Dot(a);
  // atan2(y, x), y >= 0, by the smaller quotient of the two.
  const F8 abs_x = Abs8(x);
  const F8 low = Min8(abs_x, y), high = Max8(abs_x, y);
  const F8 q = low / Max8(high, least);
  F8 angle = q / (one + Set8(0.28f) * q * q);
  angle = Select8(y > abs_x, Set8(0.5f * kPif) - angle, angle);
  angle = Select8(x < zero, Set8(kPif) - angle, angle);
  const V8 normal{Set8(n.x), Set8(n.y), Set8(n.z)};
  const F8 cosines =
      Max8(a.Dot(normal), zero) + Max8(b.Dot(normal), zero) + Max8(c.Dot(normal), zero);
  const F8 weight = Load8(block.luminance.data()) * angle * cosines;
  Store8(weights.data(), Min8(Max8(weight, zero), Set8(1e30f)));
}

// The irradiance that arrives if nothing is in the way.
void LightSampler::Weigh(const PunctualBlock& block, const Vec3f& p, const Vec3f& n,
                         LightTree::Weights& weights) {
  const F8 zero = Set8(0), one = Set8(1), least = Set8(std::numeric_limits<float>::min());
  const F8 vx = Load8(block.position[0].data()) - Set8(p.x),
           vy = Load8(block.position[1].data()) - Set8(p.y),
           vz = Load8(block.position[2].data()) - Set8(p.z);
  const F8 d2 = vx * vx + vy * vy + vz * vz, d = Sqrt8(d2);
  const F8 inverse_d = one / Max8(d, least);
  const F8 cosine = (vx * Set8(n.x) + vy * Set8(n.y) + vz * Set8(n.z)) * inverse_d;
  const F8 cos_spot =
      -(vx * Load8(block.direction[0].data()) + vy * Load8(block.direction[1].data()) +
        vz * Load8(block.direction[2].data())) *
      inverse_d;
  const F8 cos_inner = Load8(block.cos_inner.data()), cos_outer = Load8(block.cos_outer.data());
  F8 fall = Min8(Max8((cos_spot - cos_outer) / Max8(cos_inner - cos_outer, least), zero), one);
  // Rounding at the cone's edge may differ from the light's own: it is not 0 where that is not.
  fall = Max8(fall * fall, Select8(cos_spot >= cos_outer - Set8(1e-6f), Set8(1e-6f), zero));
  const F8 q = d / Load8(block.range.data()), q2 = q * q;
  const F8 window = Select8(q <= Set8(1.000001f), Max8(one - q2 * q2, Set8(1e-6f)), zero);
  const F8 weight =
      Load8(block.luminance.data()) * Max8(cosine, zero) * fall * window / Max8(d2, least);
  Store8(weights.data(), Select8(d2 > zero, Min8(Max8(weight, zero), Set8(1e30f)), zero));
}

Rgb LightSampler::Irradiance(const Vec3f& p, const Vec3f& ng, const Vec3f& n, uint32_t samples,
                             uint64_t key, uint32_t first_index, unsigned dimension,
                             LightCounters& counters, bool refine) const {
  const Query q{p, ng, n, accel_->LeaveSurface(p, ng), samples, key, first_index, dimension};
  Rgb irradiance;
  const uint32_t few = std::max(samples, kFewLights);
  if (directional_lights_.size() <= few) {
    for (const PreparedLight& light : directional_lights_) {
      irradiance += FromPunctual(light, q, counters);
    }
  } else {
    irradiance += FromManyDirectional(q, counters);
  }
  if (positioned_count_ <= few) {
    for (const PreparedLight& light : positioned_lights_) {
      if (MaxComponent(light.intensity) > 0.0f) irradiance += FromPunctual(light, q, counters);
    }
  } else {
    irradiance += FromPunctualLights(q, counters);
  }
  if (!emitters_.empty()) {
    irradiance += Refined(&LightSampler::FromEmitters, q, refine, counters);
  }
  if (environment_ != nullptr) {
    irradiance += Refined(&LightSampler::FromMap, q, refine, counters);
  } else if (has_sky_) {
    irradiance += Refined(&LightSampler::FromSky, q, refine, counters);
  }
  return irradiance;
}

Rgb LightSampler::Refined(Rgb (LightSampler::*from)(const Query&, LightCounters&) const,
                          const Query& q, bool refine, LightCounters& counters) const {
  if (!refine || q.samples < kFewestRefined) return (this->*from)(q, counters);
  // Two halves, independent of each other: each decides whether the other one is refined.
  Query half[2] = {q, q};
  Rgb mean[2];
  bool mixed[2];
  for (int i = 0; i < 2; ++i) {
    half[i].samples = i == 0 ? q.samples / 2 : q.samples - q.samples / 2;
    half[i].key = HashKey(q.key, 7, i, q.first_index);
    half[i].first_index = 0;
    const uint64_t rays = counters.rays, blocked = counters.blocked;
    mean[i] = (this->*from)(half[i], counters);
    mixed[i] = counters.blocked != blocked && counters.blocked - blocked != counters.rays - rays;
  }
  Rgb sum;
  for (int i = 0; i < 2; ++i) {
    if (mixed[1 - i]) {
      Query rest = half[i];
      rest.first_index = half[i].samples;
      rest.samples = (kRefined - 1) * half[i].samples;
      mean[i] = (mean[i] + (this->*from)(rest, counters) * static_cast<float>(kRefined - 1)) *
                (1.0f / kRefined);
    }
    sum += mean[i] * (static_cast<float>(half[i].samples) / static_cast<float>(q.samples));
  }
  return sum;
}

Rgb LightSampler::FromPunctual(const PreparedLight& light, const Query& q,
                               LightCounters& counters) const {
  Vec3f to_light;
  float d_m = std::numeric_limits<float>::infinity();
  Rgb arriving;  // irradiance on a facing surface
  if (light.kind == static_cast<uint32_t>(PunctualKind::kDirectional)) {
    to_light = -light.direction;
    arriving = light.intensity;
  } else {
    const Vec3f v = light.position - q.p;
    d_m = Length(v);
    to_light = NormalizeOr(v, q.ng);
    float f = RangeWindow(light, d_m);
    if (light.kind == static_cast<uint32_t>(PunctualKind::kSpot)) {
      f *= SpotFalloff(light, -Dot(to_light, light.direction));
    }
    // A light exactly at the point has no direction from it and lights nothing there.
    const float d2 = d_m * d_m;
    arriving = d2 > 0.0f ? light.intensity * (f / d2) : Rgb();
  }
  const float cosine = Dot(q.n, to_light);
  if (!(cosine > 0.0f) || !(Dot(q.ng, to_light) > 0.0f) || !(MaxComponent(arriving) > 0.0f) ||
      !IsFinite(arriving)) {
    ++counters.skipped_facing_away;
    return {};
  }
  ++counters.rays;
  // A light's ray ends a surface offset short of it, in case it touches a surface itself.
  const float t_max = d_m - 2.0f * accel_->surface_offset_m();
  if (t_max > 0.0f && accel_->Occluded(q.origin, to_light, t_max)) {
    ++counters.blocked;
    return {};
  }
  return arriving * cosine;
}

Rgb LightSampler::FromPunctualLights(const Query& q, LightCounters& counters) const {
  const uint32_t seed = static_cast<uint32_t>(HashKey(q.key, 3));
  LightTree::Cache cache;
  Rgb sum;
  for (uint32_t i = 0; i < q.samples; ++i) {
    double u = OwenSobolBits(q.first_index + i, q.dimension, seed) * 0x1p-32;
    ++counters.samples;
    const auto choice =
        punctual_tree_.Choose(q.p, q.n, u, cache, [&](uint32_t block, LightTree::Weights& weights) {
          Weigh(punctual_blocks_[block], q.p, q.n, weights);
        });
    if (!choice) {
      ++counters.skipped_facing_away;
      continue;
    }
    sum += FromPunctual(positioned_lights_[choice->place], q, counters) *
           static_cast<float>(1.0 / choice->probability);
  }
  return sum / static_cast<float>(q.samples);
}

// Systematic sampling: the lights lie side by side, each as long as it is bright at the point, and
// a comb of `samples` teeth is laid over them.
Rgb LightSampler::FromManyDirectional(const Query& q, LightCounters& counters) const {
  const auto weight_of = [&](const PreparedLight& light) {
    const float cosine = -Dot(q.n, light.direction);
    return cosine > 0.0f ? static_cast<double>(Luminance(light.intensity) * cosine) : 0.0;
  };
  double total = 0;
  for (const PreparedLight& light : directional_lights_) total += weight_of(light);
  counters.samples += q.samples;
  if (!(total > 0)) {
    counters.skipped_facing_away += q.samples;
    return {};
  }
  const uint32_t seed = static_cast<uint32_t>(HashKey(q.key, 4));
  const double offset = OwenSobolBits(q.first_index / q.samples, q.dimension, seed) * 0x1p-32;
  const double step = total / q.samples;
  Rgb sum;
  double below = 0;
  uint32_t tooth = 0;
  for (const PreparedLight& light : directional_lights_) {
    const double weight = weight_of(light);
    below += weight;
    uint32_t hits = 0;
    while (tooth < q.samples && (tooth + offset) * step < below) {
      ++tooth;
      ++hits;
    }
    if (hits == 0) continue;
    sum += FromPunctual(light, q, counters) * static_cast<float>(hits * (step / weight));
  }
  return sum;
}

Rgb LightSampler::FromEmitters(const Query& q, LightCounters& counters) const {
  const PreparedScene& scene = accel_->scene();
  const uint32_t seed = static_cast<uint32_t>(HashKey(q.key, 1));
  LightTree::Cache cache;
  Rgb sum;
  for (uint32_t i = 0; i < q.samples; ++i) {
    double u = OwenSobolBits(q.first_index + i, q.dimension, seed) * 0x1p-32;
    const float v = OwenSobol(q.first_index + i, q.dimension + 1, seed);
    ++counters.samples;
    const auto choice = emitter_tree_.Choose(
        q.origin, q.n, u, cache, [&](uint32_t block, LightTree::Weights& weights) {
          Weigh(emitter_blocks_[block], q.origin, q.n, weights);
        });
    if (!choice) {
      ++counters.skipped_facing_away;
      continue;
    }
    const Emitter& e = emitters_[choice->place];
    const std::optional<EmitterPoint> point =
        SamplePoint(e, q.origin, q.n, std::min(static_cast<float>(u), 0.99999994f), v);
    if (!point || !(Dot(q.n, point->direction) > 0.0f) || !(Dot(q.ng, point->direction) > 0.0f)) {
      ++counters.skipped_facing_away;
      continue;
    }
    const PreparedMaterial& material = scene.MaterialOf(e.triangle);
    Rgb radiance = material.emission;
    if (e.varies) {
      const SurfaceSample surface = scene.Surface(e.triangle, point->b1, point->b2);
      radiance = surface.alpha < material.alpha_cutoff ? Rgb() : surface.emission;
      if (!(MaxComponent(radiance) > 0.0f)) {  // black, or a hole of an alpha mask
        ++counters.skipped_facing_away;
        continue;
      }
    }
    // Up to two surface offsets over the emitter's plane, not along the ray: a grazing ray would
    // hit the emitter itself.
    const float reach_m =
        point->distance_m * (1.0f - 2.0f * accel_->surface_offset_m() / point->height_m);
    ++counters.rays;
    if (reach_m > 0.0f && accel_->Occluded(q.origin, point->direction, reach_m)) {
      ++counters.blocked;
      continue;
    }
    sum += radiance * (Dot(q.n, point->direction) * point->inverse_pdf_sr /
                       static_cast<float>(choice->probability));
  }
  return sum / static_cast<float>(q.samples);
}

Rgb LightSampler::FromSky(const Query& q, LightCounters& counters) const {
  const uint32_t seed = static_cast<uint32_t>(HashKey(q.key, 2));
  const Frame frame(q.n);
  uint32_t open = 0;
  for (uint32_t i = 0; i < q.samples; ++i) {
    const Vec3f w =
        frame.ToWorld(CosineHemisphere(OwenSobol(q.first_index + i, q.dimension, seed),
                                       OwenSobol(q.first_index + i, q.dimension + 1, seed)));
    if (!(Dot(q.ng, w) > 0.0f)) continue;
    ++counters.rays;
    if (accel_->Occluded(q.origin, w)) {
      ++counters.blocked;
    } else {
      ++open;
    }
  }
  return accel_->scene().sky() * (kPif * static_cast<float>(open) / static_cast<float>(q.samples));
}

Rgb LightSampler::FromMap(const Query& q, LightCounters& counters) const {
  const uint32_t seed = static_cast<uint32_t>(HashKey(q.key, 2));
  EnvironmentSampler::View view;
  environment_->LookAlong(q.n, view);
  Rgb sum;
  for (uint32_t i = 0; i < q.samples; ++i) {
    ++counters.samples;
    const auto draw =
        environment_->Sample(view, OwenSobolBits(q.first_index + i, q.dimension, seed) * 0x1p-32,
                             OwenSobolBits(q.first_index + i, q.dimension + 1, seed) * 0x1p-32);
    if (!draw || !(Dot(q.ng, draw->direction) > 0.0f)) {
      ++counters.skipped_facing_away;
      continue;
    }
    ++counters.rays;
    if (accel_->Occluded(q.origin, draw->direction)) {
      ++counters.blocked;
    } else {
      sum += draw->contribution;
    }
  }
  return sum / static_cast<float>(q.samples);
}

}  // namespace farpoint
