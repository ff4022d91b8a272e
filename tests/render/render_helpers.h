// Scenes and short cuts for tests that render.
#pragma once

#include <gtest/gtest.h>

#include <cmath>

#include "core/image/film.h"
#include "core/math/elementary.h"
#include "core/render/bake.h"
#include "core/render/frame_renderer.h"
#include "core/scene/procedural.h"

namespace farpoint {

inline Camera LookAt(const Vec3d& eye, const Vec3d& target, const Vec3d& up, double yfov_deg) {
  Camera c;
  c.eye = eye;
  c.forward = Normalize(target - eye);
  c.right = Normalize(Cross(c.forward, up));
  c.up = Cross(c.right, c.forward);
  c.yfov_rad = yfov_deg * kPi / 180.0;
  return c;
}

inline FilmSpec Whole(int width, int height) { return {width, height, {0, 0, width, height}}; }

struct Rendered {
  Film film;
  Stats stats;
};

// Renders the crop in one tile on `threads` threads.
inline Rendered RenderScene(const Scene& scene, const Camera& camera, const FilmSpec& film,
                            RenderSettings settings, unsigned threads = 2) {
  Executor executor(threads);
  Rendered out;
  const auto baked = Bake(scene, settings, executor, out.stats);
  EXPECT_TRUE(baked.ok()) << baked.status();
  const auto loaded = LoadedScene::Load(*baked, executor);
  EXPECT_TRUE(loaded.ok()) << loaded.status();
  const auto renderer = FrameRenderer::Create(*loaded, {camera, film, settings});
  EXPECT_TRUE(renderer.ok()) << renderer.status();
  auto tile = (*renderer)->RenderTile(film.crop, executor, {}, nullptr);
  EXPECT_TRUE(tile.ok()) << tile.status();
  out.film = std::move(tile->film);
  out.stats += tile->stats;
  return out;
}

struct ErrorOfLayer {
  double rr, bias, mean;
};

// RMSE and bias of `a` relative to the mean of `b`, over pixels that both hit and that are lit.
inline ErrorOfLayer Compare(const Film& a, const Film& b, Layer layer) {
  double square = 0, difference = 0, mean = 0;
  for (int c = 0; c < 3; ++c) {
    const auto pa = a.Plane(layer, c), pb = b.Plane(layer, c);
    for (size_t i = 0; i < pa.size(); ++i) {
      const double d = static_cast<double>(pa[i]) - static_cast<double>(pb[i]);
      square += d * d;
      difference += d;
      mean += pb[i];
    }
  }
  const double n = 3.0 * static_cast<double>(a.Plane(layer, 0).size());
  return {std::sqrt(square / n) / (mean / n), difference / mean, mean / n};
}

// A mesh of one flat polygon fan about `centre`, in the plane z = centre.z, facing `up` (+1: +z).
inline Mesh DiscMesh(const Vec3f& centre, float radius, int segments, int up) {
  Mesh mesh;
  mesh.name = "disc";
  mesh.positions.push_back(centre);
  for (int i = 0; i < segments; ++i) {
    const SinCos sc = DetSinCos(2 * kPi * i / segments);
    mesh.positions.push_back(centre + Vec3f(static_cast<float>(radius * sc.cos),
                                            static_cast<float>(radius * sc.sin), 0));
  }
  for (int i = 0; i < segments; ++i) {
    const uint32_t a = 1 + static_cast<uint32_t>(i);
    const uint32_t b = 1 + static_cast<uint32_t>((i + 1) % segments);
    if (up > 0) {
      mesh.triangles.push_back({0, a, b});
    } else {
      mesh.triangles.push_back({0, b, a});
    }
  }
  return mesh;
}

inline Mesh QuadMesh(const Vec3f& a, const Vec3f& b, const Vec3f& c, const Vec3f& d) {
  Mesh mesh;
  mesh.name = "quad";
  mesh.positions = {a, b, c, d};
  mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
  return mesh;
}

// Adds `mesh` with a Lambert material of albedo `rho`, once.
inline void AddLambert(Scene& scene, Mesh mesh, float rho) {
  Material material;
  material.base_color = Rgb(rho, rho, rho);
  mesh.material = static_cast<int32_t>(scene.materials.size());
  scene.materials.push_back(material);
  Instance instance;
  instance.mesh = static_cast<uint32_t>(scene.meshes.size());
  scene.meshes.push_back(std::move(mesh));
  scene.instances.push_back(instance);
}

}  // namespace farpoint
