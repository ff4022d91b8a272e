#include "core/light/light_sampler.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <span>

#include "core/base/fp_trap.h"
#include "core/math/elementary8.h"
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

// A triangle that fills less than this is sampled by area: the directions to its corners are too
// near to each other for their digits, and over so little the two densities are the same.
constexpr float kSmallSolidAngle = 1e-3f;

// [0, 1) -> [0, 1] by a density in proportion to what goes from f0 to f1 (both > 0).
struct LinearDraw {
  F8 x;
  F8 twice_mean, twice_value;  // of the density, times any factor
};
LinearDraw SampleLinear(F8 u, F8 f0, F8 f1) {
  const F8 sum = f0 + f1;
  const F8 x = Min8(u * sum / (f0 + Sqrt8(f0 * f0 + u * (f1 * f1 - f0 * f0))), Set8(1.0f));
  return {x, sum, Set8(2.0f) * (f0 + (f1 - f0) * x)};
}

// As UniformTriangle.
void UniformTriangle8(F8& u, F8& v) {
  const F8 half = Set8(0.5f);
  const M8 upper = v > u;
  const F8 b1 = Select8(upper, u * half, u - v * half), b2 = Select8(upper, v - u * half, v * half);
  u = b1;
  v = b2;
}

// p[offset[k]] in lane k.
F8 Gather8(const float* p, const std::array<int64_t, 8>& offset) {
  const auto half = [&](int k) {
    return _mm256_i64gather_ps(
        p, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(offset.data() + k)), sizeof(float));
  };
  return reinterpret_cast<F8>(_mm256_set_m128(half(4), half(0)));
}

// The least power of a light beside one of power 1 that keeps it a normal number.
constexpr float kLeastPower = 0x1p-100f;

// Of the environment, over the sphere.
float MeanLuminance(const PreparedScene& scene) {
  const uint32_t width = scene.map_width(), height = scene.map_height();
  double sum = 0;
  for (uint32_t y = 0; y < height; ++y) {
    double row = 0;
    for (uint32_t x = 0; x < width; ++x)
      row += static_cast<double>(Luminance(scene.MapTexel(x, y)));
    // cos of the latitudes of its edges, from the top: the row's share of the sphere is their
    // difference over two.
    const double share = DetSinCos(kPi * y / height).cos - DetSinCos(kPi * (y + 1) / height).cos;
    sum += 0.5 * share * row / width;
  }
  return static_cast<float>(sum) + Luminance(scene.sky());
}

float InversePowerOfTwo(float x) {
  int exponent = 0;
  std::frexp(x, &exponent);
  return std::ldexp(1.0f, std::clamp(-exponent, -126, 126));
}

}  // namespace

LightSampler::EmitterLanes LightSampler::LoadEmitters(const U8& place) const {
  const auto load = [](const auto& of) {
    const auto vector = [&](size_t first) { return V8(of(first), of(first + 1), of(first + 2)); };
    return EmitterLanes{vector(0), vector(3), vector(6), vector(9), of(12), of(13)};
  };
  // The fields of a block, as EmitterBlock has them: eight floats each.
  const auto* blocks = reinterpret_cast<const float*>(emitter_blocks_.data());
  constexpr size_t kWidth = LightTree::kWidth;
  static_assert(sizeof(EmitterBlock) == 14 * kWidth * sizeof(float));
  if (emitter_tree_.is_one_block()) {
    const auto lane = reinterpret_cast<__m256i>(place);
    return load([&](size_t field) {
      return reinterpret_cast<F8>(
          _mm256_permutevar8x32_ps(_mm256_load_ps(blocks + field * kWidth), lane));
    });
  }
  std::array<int64_t, kWidth> offset;
  for (size_t k = 0; k < kWidth; ++k) {
    offset[k] = static_cast<int64_t>(place[k] / kWidth * 14 * kWidth + place[k] % kWidth);
  }
  return load([&](size_t field) { return Gather8(blocks + field * kWidth, offset); });
}

// By solid angle: bounded however near the emitter comes, where sampling by area has the unbounded
// factor cosθ_l / d². Arvo's map ("Stratified Sampling of Spherical Triangles", 1995) in the form
// of Peters 2021 ("BRDF Importance Sampling for Polygonal Lights", 4), which needs one arc tangent
// and one sine and cosine, and holds in single precision.
LightSampler::EmitterDirections LightSampler::Directions(const EmitterSamples& samples) const {
  const F8 zero = Set8(0.0f), one = Set8(1.0f), two = Set8(2.0f);
  const F8 least = Set8(std::numeric_limits<float>::min());
  const EmitterLanes e = LoadEmitters(samples.place);
  const V8 to_a = e.a - samples.origin, to_b = e.b - samples.origin, to_c = e.c - samples.origin;
  const F8 length_a = Sqrt8(Length2(to_a)), length_b = Sqrt8(Length2(to_b)),
           length_c = Sqrt8(Length2(to_c));
  const F8 height = Dot(to_a, e.normal);  // of the plane over the origin, signed
  EmitterDirections out;
  out.height_m = Abs8(height);
  out.offset_m = SurfaceOffset(e.a, e.b, e.c, e.normal, samples.origin);
  // Else at a corner, or in the triangle's plane: nothing arrives.
  out.any = (length_a > zero) & (length_b > zero) & (length_c > zero) & (out.height_m > zero);
  const F8 inverse_a = one / Max8(length_a, least), inverse_b = one / Max8(length_b, least),
           inverse_c = one / Max8(length_c, least);
  const V8 a = to_a * inverse_a, b = to_b * inverse_b, c = to_c * inverse_c;
  // The solid angle by Van Oosterom and Strackee 1983, as in WeightOf.
  const F8 ab = Dot(a, b), ca = Dot(c, a), ca_bc = ca + Dot(b, c);
  const F8 triple = (e.twice_area * inverse_a * inverse_b) * (out.height_m * inverse_c);
  const F8 half_angle = DetAtan2Upper8(triple, one + ab + ca_bc);
  const F8 solid_angle = two * half_angle;

  // (u, v) = (., 0), (0, 1), (1, 1) become b, a, c below: the corners' cosines make a bilinear
  // density over the square that is near to the cosine (Hart et al. 2020, "Practical Product
  // Sampling by Fitting and Composing Warps").
  const F8 least_cosine = Set8(0.01f);
  const F8 cos_a = Max8(Dot(samples.n, a), least_cosine);
  const F8 cos_b = Max8(Dot(samples.n, b), least_cosine);
  const F8 cos_c = Max8(Dot(samples.n, c), least_cosine);
  const LinearDraw draw_v = SampleLinear(samples.v, two * cos_b, cos_a + cos_c);
  const F8 v = draw_v.x;
  const LinearDraw draw_u =
      SampleLinear(samples.u, cos_b + (cos_a - cos_b) * v, cos_b + (cos_c - cos_b) * v);
  const F8 u = draw_u.x;
  // The sub-triangle of area u Ω: its third corner d lies on the arc from a to c, where a is
  // mirrored at `middle`.
  const SinCos8 part = DetSinCos8(u * half_angle);
  const V8 middle = a * (triple * part.cos - ca_bc * part.sin) + c * ((one + ab) * part.sin);
  const V8 d = middle * (two * Dot(a, middle) / Max8(Dot(middle, middle), least)) - a;
  // On the arc from b to d, by the height over b: cos = 1 - v (1 - cos of the whole arc). Near to
  // b and near to -b, d is told by its difference.
  const V8 sum = d + b, difference = d - b;
  const F8 below = Set8(0.5f) * Length2(difference), above = Set8(0.5f) * Length2(sum);
  const V8 base = Select8(below < above, difference, sum);
  const V8 aside = base - b * Dot(b, base);
  const F8 sin2 = v * below * (two * (one - v) + v * above);
  const V8 w = b * (one - v * below) + aside * Sqrt8(sin2 / Max8(Length2(aside), least));
  const F8 cos_l = Dot(w, e.normal);
  out.any &= cos_l * height > zero;
  out.direction = w;
  out.distance_m = height / cos_l;
  out.solid_angle = Max8(solid_angle, least);
  out.inverse_pdf_sr = solid_angle * (draw_u.twice_mean * draw_v.twice_mean) /
                       (draw_u.twice_value * draw_v.twice_value);

  const M8 small = solid_angle <= Set8(kSmallSolidAngle);
  if (Bits8(small & out.any) == 0) return out;
  F8 b1 = samples.u, b2 = samples.v;
  UniformTriangle8(b1, b2);
  const V8 q = to_a + (e.b - e.a) * b1 + (e.c - e.a) * b2;
  const F8 q2 = Length2(q), distance = Sqrt8(q2);
  out.direction = Select8(small, q / distance, out.direction);
  out.distance_m = Select8(small, distance, out.distance_m);
  out.inverse_pdf_sr = Select8(small, (out.height_m / distance) * (Set8(0.5f) * e.twice_area / q2),
                               out.inverse_pdf_sr);
  return out;
}

LightSampler::LightSampler(std::shared_ptr<const RayAccel> accel) : accel_(std::move(accel)) {
  const PreparedScene& scene = accel_->scene();
  AddEmitters();
  AddPunctualLights();
  if (scene.has_environment_map()) {
    environment_ = std::make_unique<EnvironmentSampler>(scene);
    if (scene.has_gloss()) mean_sky_ = MeanLuminance(scene);
  }
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
    e.radiance = material.emission;
    e.varies = material.emission_texture >= 0 || material.alpha_cutoff >= 0.0f;
    found.push_back(e);
    luminance.push_back(mean);
    brightest = std::max(brightest, mean);
  }
  if (found.empty()) return;
  emitter_count_ = static_cast<uint32_t>(found.size());
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
    if (scene.has_gloss()) place_of_emitter_.emplace_back(e.triangle, static_cast<uint32_t>(i));
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
  std::sort(place_of_emitter_.begin(), place_of_emitter_.end());
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
F8 LightSampler::WeightOf(const EmitterLanes& e, const V8& p, const V8& n) {
  const FpTrapPause pause;  // lanes that are left out
  const F8 zero = Set8(0), one = Set8(1), least = Set8(std::numeric_limits<float>::min());
  const auto inverse_of = [&](const V8& to) { return one / Max8(Sqrt8(Length2(to)), least); };
  const V8 to_a = e.a - p, to_b = e.b - p, to_c = e.c - p;
  const F8 inverse_a = inverse_of(to_a), inverse_b = inverse_of(to_b), inverse_c = inverse_of(to_c);
  const V8 a = to_a * inverse_a, b = to_b * inverse_b, c = to_c * inverse_c;
  const F8 height = Abs8(Dot(to_a, e.normal));
  const F8 y = (e.twice_area * inverse_a * inverse_b) * (height * inverse_c);
  const F8 x = one + Dot(a, b) + Dot(b, c) + Dot(c, a);
  // atan2(y, x), y >= 0, by the smaller quotient of the two.
  const F8 abs_x = Abs8(x);
  const F8 low = Min8(abs_x, y), high = Max8(abs_x, y);
  const F8 q = low / Max8(high, least);
  F8 angle = q / (one + Set8(0.28f) * q * q);
  angle = Select8(y > abs_x, Set8(0.5f * kPif) - angle, angle);
  angle = Select8(x < zero, Set8(kPif) - angle, angle);
  const F8 cosines = Max8(Dot(a, n), zero) + Max8(Dot(b, n), zero) + Max8(Dot(c, n), zero);
  return Min8(Max8(e.luminance * angle * cosines, zero), Set8(1e30f));
}

void LightSampler::Weigh(const EmitterBlock& block, const Vec3f& p, const Vec3f& n,
                         LightTree::Weights& weights) {
  const auto load = [](const LightTree::Weights(&v)[3]) {
    return V8(Load8(v[0].data()), Load8(v[1].data()), Load8(v[2].data()));
  };
  const EmitterLanes lanes{load(block.a),
                           load(block.b),
                           load(block.c),
                           load(block.normal),
                           Load8(block.twice_area.data()),
                           Load8(block.luminance.data())};
  Store8(weights.data(), WeightOf(lanes, V8(p), V8(n)));
}

// The irradiance that arrives if nothing is in the way.
void LightSampler::Weigh(const PunctualBlock& block, const Vec3f& p, const Vec3f& n,
                         LightTree::Weights& weights) {
  const FpTrapPause pause;  // lanes that are left out
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

void LightSampler::Skip(const Query& q, const Vec3f& direction, float reach_m,
                        LightCounters& counters) const {
  if ((q.needless & kNeedlessRays) == 0) {
    ++counters.skipped_facing_away;
    return;
  }
  ++counters.needless;
  // Emitters that are seen edge-on have no direction.
  const float length2 = Length2(direction);
  if (reach_m > 0.0f && length2 > 0.9f && length2 < 1.1f) {
    (void)accel_->Occluded(q.origin, direction, reach_m);
  }
}

void LightSampler::IrradianceEach(std::span<const SurfacePoints8> points, uint64_t key,
                                  unsigned dimension, std::span<V8> irradiance,
                                  LightCounters& counters, unsigned needless) const {
  const auto for_each_lane = [&](size_t i, const auto& from) {
    for (unsigned rest = points[i].active; rest != 0; rest &= rest - 1) {
      const auto k = static_cast<size_t>(std::countr_zero(rest));
      const SurfacePoint at = points[i].Lane(k);
      const Query q{at.p,     at.ng, at.n, at.Leave(), at.offset_m, 1, key, points[i].index[k],
                    dimension};
      irradiance[i].SetLane(k, irradiance[i].Lane(k) + from(q));
    }
  };
  if (needless != 0) {
    for (size_t i = 0; i < points.size(); ++i) {
      irradiance[i] = V8(Vec3f());
      for (unsigned rest = points[i].active; rest != 0; rest &= rest - 1) {
        const auto k = static_cast<size_t>(std::countr_zero(rest));
        irradiance[i].SetLane(k, Irradiance(points[i].Lane(k), 1, key, points[i].index[k],
                                            dimension, counters, {}, true, needless));
      }
    }
    return;
  }
  const bool any_punctual = !directional_lights_.empty() || !positioned_lights_.empty();
  for (size_t i = 0; i < points.size(); ++i) {
    irradiance[i] = V8(Vec3f());
    if (any_punctual) {
      for_each_lane(i, [&](const Query& q) { return FromAllPunctual(q, counters); });
    }
  }
  if (!emitters_.empty()) {
    constexpr size_t kTogether = 8;
    std::array<ShadowRays8, kTogether> rays;
    for (size_t first = 0; first < points.size(); first += kTogether) {
      const size_t count = std::min(points.size() - first, kTogether);
      for (size_t i = 0; i < count; ++i) {
        rays[i] = RaysTo(SampleEach(points[first + i], key, dimension));
        const auto lanes = static_cast<uint32_t>(std::popcount(points[first + i].active));
        counters.samples += lanes;
        counters.skipped_facing_away +=
            lanes - static_cast<uint32_t>(std::popcount(rays[i].active));
      }
      for (size_t i = 0; i < count; ++i) {
        Trace(rays[i], false, counters);
        irradiance[first + i] = irradiance[first + i] + rays[i].arriving;
      }
    }
  }
  if (!has_sky_) {
    for (const SurfacePoints8& p : points) {
      counters.skipped_environments += static_cast<uint32_t>(std::popcount(p.active));
    }
    return;
  }
  for (size_t i = 0; i < points.size(); ++i) {
    for_each_lane(i, [&](const Query& q) {
      return environment_ != nullptr ? FromMap(q, counters) : FromSky(q, counters);
    });
  }
}

Rgb LightSampler::Irradiance(const SurfacePoint& at, uint32_t samples, uint64_t key,
                             uint32_t first_index, unsigned dimension, LightCounters& counters,
                             Refinement refine, bool environment, unsigned needless) const {
  return Estimate(
      {at.p, at.ng, at.n, at.Leave(), at.offset_m, samples, key, first_index, dimension, needless},
      refine, environment, counters);
}

Rgb LightSampler::Reflected(const SurfacePoint& at, const Reflector& reflector, uint32_t samples,
                            uint64_t key, uint32_t first_index, unsigned dimension,
                            LightCounters& counters, Refinement refine, bool environment,
                            unsigned needless) const {
  return Estimate({at.p, at.ng, at.n, at.Leave(), at.offset_m, samples, key, first_index, dimension,
                   needless, &reflector},
                  refine, environment, counters);
}

Rgb LightSampler::Estimate(const Query& q, const Refinement& refine, bool environment,
                           LightCounters& counters) const {
  const unsigned needless = q.needless;
  Rgb irradiance = FromAllPunctual(q, counters);
  if (!emitters_.empty()) {
    irradiance += Refined(&LightSampler::FromEmitters, q, refine.emitters, counters);
  }
  if (!environment) return irradiance;
  if (environment_ != nullptr) {
    irradiance += Refined(&LightSampler::FromMap, q, refine.environment, counters);
  } else if (has_sky_) {
    irradiance += Refined(&LightSampler::FromSky, q, refine.environment, counters);
  } else if ((needless & kNeedlessEnvironment) != 0) {
    // A black one.
    LightCounters black;
    irradiance += FromSky(q, black);
    counters.needless += black.rays + black.needless;
    counters.skipped_facing_away += black.skipped_facing_away;
  } else {
    ++counters.skipped_environments;
  }
  return irradiance;
}

Rgb LightSampler::Refined(Rgb (LightSampler::*from)(const Query&, LightCounters&) const,
                          const Query& q, uint32_t times, LightCounters& counters) const {
  if (times <= 1 || q.samples < kFewestRefined) return (this->*from)(q, counters);
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
      rest.samples = (times - 1) * half[i].samples;
      mean[i] = (mean[i] + (this->*from)(rest, counters) * static_cast<float>(times - 1)) *
                (1.0f / static_cast<float>(times));
    }
    sum += mean[i] * (static_cast<float>(half[i].samples) / static_cast<float>(q.samples));
  }
  return sum;
}

Rgb LightSampler::FromAllPunctual(const Query& q, LightCounters& counters) const {
  const uint32_t few = std::max(q.samples, kFewLights);
  Rgb irradiance;
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
  return irradiance;
}

Rgb LightSampler::FromPunctual(const PreparedLight& light, const Query& q,
                               LightCounters& counters) const {
  const FpTrapPause pause;  // a light may be too near for a float: see below
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
    Skip(q, to_light, d_m, counters);
    return {};
  }
  ++counters.rays;
  // A light's ray ends a little short of it, in case it touches a surface itself.
  const float t_max =
      d_m - q.offset_m - 2.0f * kOffsetOfPlane * (MaxAbs(light.position) + MaxAbs(q.p));
  if (t_max > 0.0f && accel_->Occluded(q.origin, to_light, t_max)) {
    ++counters.blocked;
    return {};
  }
  if (q.reflector != nullptr) {
    arriving *= q.reflector->Toward(to_light, std::numeric_limits<float>::infinity());
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
  const uint32_t seed = static_cast<uint32_t>(HashKey(q.key, 1));
  const OwenSobolAxis axis_u(q.dimension, seed), axis_v(q.dimension + 1, seed);
  LightTree::Cache cache;
  const auto weigh = [&](uint32_t block, LightTree::Weights& weights) {
    Weigh(emitter_blocks_[block], q.origin, q.n, weights);
  };
  std::array<F8, LightTree::kWidth> of_block;
  if (emitter_tree_.is_one_block()) {
    alignas(32) LightTree::Weights weights;
    weigh(0, weights);
    for (size_t i = 0; i < emitter_count_; ++i) of_block[i] = Set8(weights[i]);
  }
  EmitterSamples samples;
  samples.origin = V8(q.origin);
  samples.n = V8(q.n);
  samples.ng = V8(q.ng);
  const U8 lanes = {0, 1, 2, 3, 4, 5, 6, 7};
  Rgb sum;
  for (uint32_t first = 0; first < q.samples; first += LightTree::kWidth) {
    const U8 index = lanes + (q.first_index + first);
    const U8 bits = axis_u.BitsOf(index);
    const uint32_t count = std::min(q.samples - first, LightTree::kWidth);
    samples.v = axis_v.PointsOf(index);
    if (emitter_tree_.is_one_block()) {
      samples.Set(LightTree::ChooseInBlock8(std::span(of_block).first(emitter_count_), bits),
                  (1u << count) - 1u);
    } else {
      samples.active = 0;
      for (uint32_t k = 0; k < count; ++k) {
        double u = bits[k] * 0x1p-32;
        samples.Set(k, u, emitter_tree_.Choose(q.origin, q.n, u, cache, weigh));
      }
    }
    ShadowRays8 rays = RaysTo(samples, q.reflector);
    counters.samples += count;
    for (unsigned rest = ((1u << count) - 1u) & ~rays.active; rest != 0; rest &= rest - 1) {
      const auto k = static_cast<size_t>(std::countr_zero(rest));
      Skip(q, rays.direction[k], rays.reach_m[k], counters);
    }
    Trace(rays, true, counters);
    for (uint32_t k = 0; k < count; ++k) sum += rays.arriving.Lane(k);
  }
  return sum / static_cast<float>(q.samples);
}

LightSampler::EmitterSamples LightSampler::SampleEach(const SurfacePoints8& points, uint64_t key,
                                                      unsigned dimension) const {
  const uint32_t seed = static_cast<uint32_t>(HashKey(key, 1));
  const U8 bits = OwenSobolAxis(dimension, seed).BitsOf(points.index);
  EmitterSamples samples;
  samples.origin = points.p + points.ng * points.offset_m;
  samples.n = points.n;
  samples.ng = points.ng;
  samples.v = OwenSobolAxis(dimension + 1, seed).PointsOf(points.index);
  if (emitter_tree_.is_one_block()) {
    // One emitter after the other for all points.
    std::array<F8, LightTree::kWidth> weights;
    for (uint32_t place = 0; place < emitter_count_; ++place) {
      weights[place] = WeightOf(LoadEmitters(U8{} + place), samples.origin, points.n);
    }
    samples.Set(LightTree::ChooseInBlock8(std::span(weights).first(emitter_count_), bits),
                points.active);
    return samples;
  }
  for (unsigned rest = points.active; rest != 0; rest &= rest - 1) {
    const auto k = static_cast<uint32_t>(std::countr_zero(rest));
    double u = bits[k] * 0x1p-32;
    const Vec3f p = samples.origin.Lane(k), n = points.n.Lane(k);
    LightTree::Cache cache;
    samples.Set(
        k, u,
        emitter_tree_.Choose(p, n, u, cache, [&](uint32_t block, LightTree::Weights& weights) {
          Weigh(emitter_blocks_[block], p, n, weights);
        }));
  }
  return samples;
}

LightSampler::ShadowRays8 LightSampler::RaysTo(const EmitterSamples& samples,
                                               const Reflector* reflector) const {
  const FpTrapPause pause;  // lanes that are left out
  const EmitterDirections to = Directions(samples);
  const F8 zero = Set8(0.0f);
  const F8 cosine = Dot(samples.n, to.direction);
  ShadowRays8 rays;
  for (size_t k = 0; k < LightTree::kWidth; ++k) {
    rays.origin[k] = samples.origin.Lane(k);
    rays.direction[k] = to.direction.Lane(k);
  }
  // Up to two offsets over the emitter's plane, not along the ray: a grazing ray would hit the
  // emitter itself.
  rays.reach_m = to.distance_m * (Set8(1.0f) - Set8(2.0f) * to.offset_m / to.height_m);
  rays.active =
      samples.active & Bits8(to.any & (cosine > zero) & (Dot(samples.ng, to.direction) > zero));
  rays.arriving = V8(Vec3f());
  for (unsigned rest = rays.active; rest != 0; rest &= rest - 1) {
    const auto k = static_cast<size_t>(std::countr_zero(rest));
    const Emitter& e = emitters_[samples.place[k]];
    Rgb radiance = e.radiance;
    if (e.varies) {
      radiance =
          e.RadianceAt(accel_->scene(), rays.origin[k] + rays.direction[k] * to.distance_m[k]);
      // Black, or a hole of an alpha mask.
      if (!(MaxComponent(radiance) > 0.0f)) rays.active &= ~(1u << k);
    }
    if (reflector != nullptr) {
      radiance *= reflector->Toward(rays.direction[k], samples.probability[k] / to.solid_angle[k]);
      if (!(MaxComponent(radiance) > 0.0f)) rays.active &= ~(1u << k);
    }
    rays.arriving.SetLane(k, radiance);
  }
  rays.arriving =
      Select8(Mask8(rays.active),
              rays.arriving * (cosine * to.inverse_pdf_sr / samples.probability), V8(Vec3f()));
  return rays;
}

void LightSampler::Trace(ShadowRays8& rays, bool from_one_point, LightCounters& counters) const {
  const FpTrapPause pause;  // lanes that are left out
  const unsigned active = rays.active & Bits8(rays.reach_m > Set8(0.0f));
  std::array<float, LightTree::kWidth> reach_m;
  std::memcpy(reach_m.data(), &rays.reach_m, sizeof(reach_m));
  const unsigned blocked =
      active == 0 ? 0
                  : accel_->Occluded8(rays.origin, rays.direction, reach_m, active, from_one_point);
  counters.rays += static_cast<uint32_t>(std::popcount(rays.active));
  counters.blocked += static_cast<uint32_t>(std::popcount(blocked));
  rays.arriving = Select8(Mask8(blocked), V8(Vec3f()), rays.arriving);
}

// The radiance at the point of a textured or holed emitter that is nearest to `q`.
Rgb LightSampler::Emitter::RadianceAt(const PreparedScene& scene, const Vec3f& q) const {
  const Vec3d at = Vec3d(q) - Vec3d(v0), along1(e1), along2(e2);
  const double d11 = Dot(along1, along1), d12 = Dot(along1, along2), d22 = Dot(along2, along2);
  const double a1 = Dot(at, along1), a2 = Dot(at, along2);
  const double determinant = d11 * d22 - d12 * d12;
  if (!(determinant > 0.0)) return {};
  const double b1 = std::clamp((a1 * d22 - a2 * d12) / determinant, 0.0, 1.0);
  const double b2 = std::clamp((a2 * d11 - a1 * d12) / determinant, 0.0, 1.0);
  const SurfaceSample surface =
      scene.Surface(triangle, static_cast<float>(b1), static_cast<float>(b2));
  return surface.alpha < scene.MaterialOf(triangle).alpha_cutoff ? Rgb() : surface.emission;
}

Rgb LightSampler::FromSky(const Query& q, LightCounters& counters) const {
  const uint32_t seed = static_cast<uint32_t>(HashKey(q.key, 2));
  const Frame frame(q.n);
  uint32_t open = 0;
  Rgb reflected;
  for (uint32_t i = 0; i < q.samples; ++i) {
    const Vec3f w =
        frame.ToWorld(CosineHemisphere(OwenSobol(q.first_index + i, q.dimension, seed),
                                       OwenSobol(q.first_index + i, q.dimension + 1, seed)));
    if (!(Dot(q.ng, w) > 0.0f)) {
      Skip(q, w, std::numeric_limits<float>::infinity(), counters);
      continue;
    }
    ++counters.rays;
    if (accel_->Occluded(q.origin, w)) {
      ++counters.blocked;
    } else {
      ++open;
      if (q.reflector != nullptr) {
        reflected += q.reflector->Toward(w, std::max(Dot(q.n, w), 0.0f) * kInvPif);
      }
    }
  }
  if (q.reflector != nullptr) {
    return accel_->scene().sky() * reflected * (kPif / static_cast<float>(q.samples));
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
      Skip(q, draw ? draw->direction : Vec3f(), std::numeric_limits<float>::infinity(), counters);
      continue;
    }
    ++counters.rays;
    if (accel_->Occluded(q.origin, draw->direction)) {
      ++counters.blocked;
    } else {
      sum += q.reflector == nullptr
                 ? draw->contribution
                 : draw->contribution *
                       q.reflector->Toward(draw->direction, MapDensity(q.n, draw->direction));
    }
  }
  return sum / static_cast<float>(q.samples);
}

// Nearly: in proportion to luminance and cosine.
float LightSampler::MapDensity(const Vec3f& n, const Vec3f& w) const {
  const float cosine = Dot(n, w);
  if (!(cosine > 0.0f) || !(mean_sky_ > 0.0f)) return 0;
  return Luminance(accel_->scene().EnvironmentRadiance(w)) * cosine / (kPif * mean_sky_);
}

LightSampler::Seen LightSampler::EnvironmentSeen(const SurfacePoint& from, const Vec3f& w) const {
  if (!has_sky_) return {};
  const Rgb radiance = accel_->scene().EnvironmentRadiance(w);
  return {radiance, environment_ != nullptr ? MapDensity(from.n, w)
                                            : std::max(Dot(from.n, w), 0.0f) * kInvPif};
}

LightSampler::Seen LightSampler::EmissionSeen(const SurfacePoint& from, const RayHit& hit) const {
  const PreparedScene& scene = accel_->scene();
  if (!(MaxComponent(scene.MaterialOf(hit.triangle).emission) > 0.0f)) return {};
  Seen seen{scene.Surface(hit.triangle, hit.b1, hit.b2).emission, 0};
  const auto found = std::lower_bound(place_of_emitter_.begin(), place_of_emitter_.end(),
                                      std::pair(hit.triangle, uint32_t{0}));
  if (found == place_of_emitter_.end() || found->first != hit.triangle) return seen;
  const Vec3f origin = from.Leave();
  LightTree::Cache cache;
  const double probability = emitter_tree_.ProbabilityOf(
      found->second, origin, from.n, cache, [&](uint32_t block, LightTree::Weights& weights) {
        Weigh(emitter_blocks_[block], origin, from.n, weights);
      });
  EmitterSamples sample;
  sample.origin = V8(origin);
  sample.n = V8(from.n);
  sample.ng = V8(from.ng);
  sample.v = Set8(0.5f);
  sample.u = Set8(0.5f);
  sample.place = U8{} + found->second;
  const FpTrapPause pause;  // lanes that are left out
  seen.density_sr = static_cast<float>(probability) / Directions(sample).solid_angle[0];
  return seen;
}

}  // namespace farpoint
