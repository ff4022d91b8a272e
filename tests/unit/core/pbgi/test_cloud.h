// Surfel clouds made by hand, for tests of what comes after sampling.
#pragma once

#include <cmath>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/pbgi/point_tree.h"
#include "core/pbgi/surfel.h"

namespace farpoint {

struct TestCloud {
  SurfelCloud cloud;
  SurfelShading shading;

  void Add(const Vec3f& p, const Vec3f& n, float area, const Rgb& front, const Rgb& back = Rgb(),
           uint8_t visible = kFrontVisible | kBackVisible) {
    cloud.position.push_back(p);
    cloud.normal.push_back(n);
    cloud.area_m2.push_back(area);
    cloud.triangle.push_back(0);
    cloud.barycentric.push_back({});
    shading.front.push_back(front);
    shading.back.push_back(back);
    shading.visible_sides.push_back(visible);
  }
  std::shared_ptr<const PointTree> Build(unsigned threads = 1) const {
    Executor executor(threads);
    const PointTree::Blobs blobs = PointTree::Build(cloud, shading, executor);
    return PointTree::FromBlobs(blobs.topology, blobs.radiance).value();
  }
};

// n surfels on a sphere that face inwards, evenly spread (spherical Fibonacci lattice).
inline TestCloud InwardSphere(int n, float radius_m, const Rgb& radiance) {
  TestCloud t;
  const double golden = kPi * (3.0 - std::sqrt(5.0));
  for (int i = 0; i < n; ++i) {
    const double z = 1.0 - 2.0 * (i + 0.5) / n;
    const double r = std::sqrt(1.0 - z * z);
    const SinCos sc = DetSinCos(golden * i);
    const Vec3f w(static_cast<float>(r * sc.cos), static_cast<float>(r * sc.sin),
                  static_cast<float>(z));
    t.Add(w * radius_m, -w, static_cast<float>(4 * kPi * radius_m * radius_m / n), radiance);
  }
  return t;
}

// A square grid of surfels in the plane z = height, edge `edge` m about the origin.
inline void AddSquare(TestCloud& t, int n, float edge, float height, const Vec3f& normal,
                      const Rgb& front, const Rgb& back = Rgb()) {
  const float step = edge / static_cast<float>(n);
  for (int j = 0; j < n; ++j) {
    for (int i = 0; i < n; ++i) {
      t.Add({(static_cast<float>(i) + 0.5f) * step - edge / 2,
             (static_cast<float>(j) + 0.5f) * step - edge / 2, height},
            normal, step * step, front, back);
    }
  }
}

// Surfels at random places with random normals and radiances.
inline TestCloud RandomCloud(int n, uint64_t seed) {
  TestCloud t;
  for (int i = 0; i < n; ++i) {
    const auto u = [&](int k) {
      return ToUnitFloat(
          static_cast<uint32_t>(HashKey(seed, static_cast<uint64_t>(i), static_cast<uint64_t>(k))));
    };
    t.Add({u(0) * 4 - 2, u(1) * 2 - 1, u(2) * 3 - 1}, UniformSphere(u(3), u(4)),
          0.0005f + 0.002f * u(5), Rgb(u(6), u(7), u(8)), Rgb(u(9), u(10), u(11)),
          static_cast<uint8_t>(u(12) < 0.2f ? kFrontVisible : kFrontVisible | kBackVisible));
  }
  return t;
}

}  // namespace farpoint
