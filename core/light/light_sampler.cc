#include "core/light/light_sampler.h"

#include <algorithm>
#include <cmath>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

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

}  // namespace

// By solid angle (Arvo 1995, "Stratified Sampling of Spherical Triangles"): bounded however near
// the emitter comes, where sampling by area has the unbounded factor cosθ_l / d².
std::optional<LightSampler::EmitterPoint> LightSampler::SamplePoint(const Emitter& e,
                                                                    const Vec3f& p, float u,
                                                                    float v) const {
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
  // Interior angles at the corners, from the planes of the great circles.
  const Vec3d n_ab = Cross(a, b), n_ca = Cross(c, a);
  const auto angle = [](const Vec3d& m, const Vec3d& n) {
    return DetAtan2(Length(Cross(m, n)), -Dot(m, n));
  };
  const double alpha = angle(n_ab, n_ca);
  const double cos_alpha = DetSinCos(alpha).cos, sin_alpha = DetSinCos(alpha).sin;
  const double cos_c = Dot(a, b);  // arc opposite to corner c
  // The sub-triangle of area u Ω: its third corner lies on the arc from a to c.
  const SinCos phi = DetSinCos(u * solid_angle - alpha);
  const double uu = phi.cos - cos_alpha;
  const double vv = phi.sin + sin_alpha * cos_c;
  const double denominator = (vv * phi.sin + uu * phi.cos) * sin_alpha;
  const double q =
      denominator != 0.0
          ? std::clamp(((vv * phi.cos - uu * phi.sin) * cos_alpha - vv) / denominator, -1.0, 1.0)
          : 1.0;
  const Vec3d toward_c = NormalizeOr(c - a * Dot(c, a), a);
  const Vec3d c_hat = a * q + toward_c * std::sqrt(std::max(0.0, 1.0 - q * q));
  const double z = 1.0 - static_cast<double>(v) * (1.0 - Dot(c_hat, b));
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
  out.inverse_pdf_sr = static_cast<float>(solid_angle);
  return out;
}

LightSampler::LightSampler(std::shared_ptr<const RayAccel> accel) : accel_(std::move(accel)) {
  const PreparedScene& scene = accel_->scene();
  double total = 0;
  std::vector<double> power;
  for (const uint32_t t : scene.emissive_triangles()) {
    const PreparedMaterial& material = scene.MaterialOf(t);
    Emitter e;
    e.triangle = t;
    e.v0 = scene.PointOn(t, 0, 0);
    e.e1 = scene.vertices()[scene.triangles()[t].vertex[1]] - e.v0;
    e.e2 = scene.vertices()[scene.triangles()[t].vertex[2]] - e.v0;
    e.normal = scene.GeometricNormal(t);
    e.area_m2 = scene.TriangleArea(t);
    e.varies = material.emission_texture >= 0 || material.alpha_cutoff >= 0.0f;
    const double p = static_cast<double>(e.area_m2) * Luminance(material.emission);
    if (!(p > 0)) continue;
    total += p;
    power.push_back(p);
    emitters_.push_back(e);
  }
  double below = 0;
  for (size_t i = 0; i < emitters_.size(); ++i) {
    emitters_[i].cdf_below = static_cast<float>(below / total);
    below += power[i];
    emitters_[i].probability = static_cast<float>(power[i] / total);
  }
  has_sky_ = MaxComponent(scene.sky()) > 0.0f;
  bool any_punctual = false;
  for (const PreparedLight& light : scene.lights()) {
    any_punctual = any_punctual || MaxComponent(light.intensity) > 0.0f;
  }
  any_light_ = has_sky_ || any_punctual || !emitters_.empty();
}

Rgb LightSampler::Irradiance(const Vec3f& p, const Vec3f& ng, const Vec3f& n, uint32_t samples,
                             uint64_t key, uint32_t first_index, unsigned dimension,
                             LightCounters& counters) const {
  const PreparedScene& scene = accel_->scene();
  const Vec3f origin = accel_->LeaveSurface(p, ng);
  Rgb irradiance;

  for (const PreparedLight& light : scene.lights()) {
    Vec3f to_light;
    float d_m = std::numeric_limits<float>::infinity();
    Rgb arriving;  // irradiance on a facing surface
    if (light.kind == static_cast<uint32_t>(PunctualKind::kDirectional)) {
      to_light = -light.direction;
      arriving = light.intensity;
    } else {
      const Vec3f v = light.position - p;
      d_m = Length(v);
      to_light = NormalizeOr(v, ng);
      float f = RangeWindow(light, d_m);
      if (light.kind == static_cast<uint32_t>(PunctualKind::kSpot)) {
        f *= SpotFalloff(light, -Dot(to_light, light.direction));
      }
      // A light exactly at the point has no direction from it and lights nothing there.
      const float d2 = d_m * d_m;
      arriving = d2 > 0.0f ? light.intensity * (f / d2) : Rgb();
    }
    const float cosine = Dot(n, to_light);
    if (!(cosine > 0.0f) || !(Dot(ng, to_light) > 0.0f) || !(MaxComponent(arriving) > 0.0f) ||
        !IsFinite(arriving)) {
      ++counters.skipped_facing_away;
      continue;
    }
    ++counters.rays;
    // A light's ray ends a surface offset short of it, in case it touches a surface itself.
    const float t_max = d_m - 2.0f * accel_->surface_offset_m();
    if (t_max > 0.0f && accel_->Occluded(origin, to_light, t_max)) continue;
    irradiance += arriving * cosine;
  }

  if (!emitters_.empty()) {
    const uint32_t seed = static_cast<uint32_t>(HashKey(key, 1));
    Rgb sum;
    for (uint32_t i = 0; i < samples; ++i) {
      float u = OwenSobol(first_index + i, dimension, seed);
      const float v = OwenSobol(first_index + i, dimension + 1, seed);
      // The last emitter whose cdf_below is <= u, then u stretched to [0, 1) within it.
      const auto it = std::upper_bound(emitters_.begin(), emitters_.end(), u,
                                       [](float x, const Emitter& e) { return x < e.cdf_below; });
      const Emitter& e = it == emitters_.begin() ? emitters_.front() : *(it - 1);
      u = std::clamp((u - e.cdf_below) / e.probability, 0.0f, 0.99999994f);
      ++counters.samples;
      const std::optional<EmitterPoint> point = SamplePoint(e, origin, u, v);
      if (!point) continue;
      const float cos_p = Dot(n, point->direction);
      if (!(cos_p > 0.0f) || !(Dot(ng, point->direction) > 0.0f)) {
        ++counters.skipped_facing_away;
        continue;
      }
      const PreparedMaterial& material = scene.MaterialOf(e.triangle);
      Rgb radiance = material.emission;
      if (e.varies) {
        const SurfaceSample surface = scene.Surface(e.triangle, point->b1, point->b2);
        if (surface.alpha < material.alpha_cutoff) continue;  // a hole of an alpha mask
        radiance = surface.emission;
      }
      // Up to two surface offsets over the emitter's plane, not along the ray: a grazing ray would
      // hit the emitter itself.
      const float reach_m =
          point->distance_m * (1.0f - 2.0f * accel_->surface_offset_m() / point->height_m);
      ++counters.rays;
      if (reach_m > 0.0f && accel_->Occluded(origin, point->direction, reach_m)) continue;
      sum += radiance * (cos_p * point->inverse_pdf_sr / e.probability);
    }
    irradiance += sum / static_cast<float>(samples);
  }

  if (has_sky_) {
    const uint32_t seed = static_cast<uint32_t>(HashKey(key, 2));
    const Frame frame(n);
    uint32_t open = 0;
    for (uint32_t i = 0; i < samples; ++i) {
      const Vec3f w =
          frame.ToWorld(CosineHemisphere(OwenSobol(first_index + i, dimension, seed),
                                         OwenSobol(first_index + i, dimension + 1, seed)));
      if (!(Dot(ng, w) > 0.0f)) continue;
      ++counters.rays;
      if (!accel_->Occluded(origin, w)) ++open;
    }
    irradiance += scene.sky() * (kPif * static_cast<float>(open) / static_cast<float>(samples));
  }
  return irradiance;
}

}  // namespace farpoint
