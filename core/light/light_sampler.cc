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

}  // namespace

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
    e.textured = material.emission_texture >= 0;
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
      const Vec2f b = UniformTriangle(u, v);
      const Vec3f q = e.v0 + e.e1 * b.x + e.e2 * b.y;
      const Vec3f d = q - origin;
      const float d2 = Length2(d);
      const float distance = std::sqrt(d2);
      const float cos_p = Dot(n, d);                    // times distance
      const float cos_l = std::fabs(Dot(e.normal, d));  // times distance
      if (!(cos_p > 0.0f) || !(Dot(ng, d) > 0.0f) || !(cos_l > 0.0f) || !(d2 > 0.0f)) {
        ++counters.skipped_facing_away;
        continue;
      }
      ++counters.rays;
      if (accel_->Occluded(origin, d, 1.0f - 2.0f * accel_->surface_offset_m() / distance)) {
        continue;
      }
      const Rgb radiance = e.textured ? scene.Surface(e.triangle, b.x, b.y).emission
                                      : scene.MaterialOf(e.triangle).emission;
      sum += radiance * ((cos_p / d2) * (cos_l / d2) * (e.area_m2 / e.probability));
    }
    irradiance += sum / static_cast<float>(samples);
  }

  if (has_sky_) {
    const uint32_t seed = static_cast<uint32_t>(HashKey(key, 2));
    const Frame frame(n);
    uint32_t open = 0;
    for (uint32_t i = 0; i < samples; ++i) {
      const Vec3f w = frame.ToWorld(CosineHemisphere(OwenSobol(first_index + i, dimension, seed),
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
