#include "core/render/bake.h"

#include <gtest/gtest.h>

#include <chrono>
#include <functional>
#include <thread>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/pbgi/point_tree.h"
#include "core/scene/procedural.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

constexpr uint64_t kCacheBytes = uint64_t{64} << 20;

struct Hashes {
  Digest scene, topology, radiance;
  bool operator==(const Hashes&) const = default;
};

struct Baked {
  BakedScene blobs;
  Hashes hashes;
  Stats stats;
  uint64_t skipped(const char* key) const {
    const auto it = stats.skipped.find(key);
    return it == stats.skipped.end() ? 0 : it->second;
  }
};

RenderSettings SmallSettings() {
  RenderSettings settings;
  settings.points = 1200;
  settings.light_samples = 4;
  return settings;
}

Baked BakeIt(const Scene& scene, const RenderSettings& settings, BakeCache* cache,
             unsigned threads = 2) {
  Executor executor(threads);
  Baked baked;
  BakeOptions options;
  options.cache = cache;
  auto blobs = Bake(scene, settings, executor, baked.stats, options);
  EXPECT_TRUE(blobs.ok()) << blobs.status();
  if (!blobs.ok()) return baked;
  baked.blobs = *std::move(blobs);
  baked.hashes = {baked.blobs.prepared_scene.Hash(), baked.blobs.tree_topology.Hash(),
                  baked.blobs.tree_radiance.Hash()};
  return baked;
}

Mesh BoxMesh(float s) {
  Mesh box;
  box.name = "box";
  for (int i = 0; i < 8; ++i) {
    box.positions.push_back({i & 1 ? s : -s, i & 2 ? s : -s, i & 4 ? s : -s});
    box.uv[0].push_back({i & 1 ? 1.0f : 0.0f, i & 2 ? 1.0f : 0.0f});
  }
  const uint32_t quads[6][4] = {{0, 2, 3, 1}, {4, 5, 7, 6}, {0, 1, 5, 4},
                                {2, 6, 7, 3}, {0, 4, 6, 2}, {1, 3, 7, 5}};
  for (const auto& q : quads) {
    box.triangles.push_back({q[0], q[1], q[2]});
    box.triangles.push_back({q[0], q[2], q[3]});
  }
  return box;
}

// The Cornell box with a sun, a closed box in the air and one with holes.
Scene TestScene() {
  Scene scene = MakeCornellBox();
  scene.lights.push_back({.name = "sun",
                          .kind = PunctualKind::kDirectional,
                          .direction = Normalize(Vec3d(0.1, -0.3, -1)),
                          .intensity = Rgb(1, 2, 3)});
  Texture texture;
  texture.name = "mask";
  texture.nearest = true;
  texture.encoded = Blob::FromString(MakePng(2, 1, {255, 255, 255, 0, 255, 255, 255, 255}));
  scene.textures.push_back(texture);
  Material masked;
  masked.name = "masked";
  masked.alpha_mode = AlphaMode::kMask;
  masked.base_color_texture.texture = static_cast<int32_t>(scene.textures.size() - 1);
  scene.materials.push_back(masked);
  const Vec3d centre = scene.instances.front().world_from_mesh.translation;
  for (const bool holes : {false, true}) {
    Mesh box = BoxMesh(0.1f);
    box.material = holes ? static_cast<int32_t>(scene.materials.size() - 1) : 0;
    scene.meshes.push_back(box);
    Instance instance;
    instance.name = holes ? "with holes" : "closed";
    instance.mesh = static_cast<uint32_t>(scene.meshes.size() - 1);
    instance.world_from_mesh.translation = centre + Vec3d(holes ? 0.6 : 0.3, 0.5, 0.4);
    scene.instances.push_back(instance);
  }
  return scene;
}

// Changes something of the scene or of the settings.
void Mutate(uint64_t random, Scene& scene, RenderSettings& settings) {
  const auto u = [&](uint64_t k) { return ToUnitFloat(static_cast<uint32_t>(HashKey(random, k))); };
  const auto pick = [&](uint64_t k, size_t n) {
    return static_cast<size_t>(HashKey(random, k) % n);
  };
  Instance& instance = scene.instances[pick(1, scene.instances.size())];
  switch (HashKey(random, 0) % 14) {
    case 0:
      if (!scene.cameras.empty()) scene.cameras[0].eye += Vec3d(0.1, 0, 0);
      break;
    case 1:
      for (PunctualLight& light : scene.lights) light.intensity *= 0.5f + u(2);
      break;
    case 2:
      for (PunctualLight& light : scene.lights) {
        light.direction = Normalize(light.direction + Vec3d(u(2) - 0.5, u(3) - 0.5, u(4) - 0.5));
      }
      break;
    case 3:
      scene.materials[pick(2, scene.materials.size())].base_color = Rgb(u(3), u(4), u(5));
      break;
    case 4:
      scene.materials[pick(2, scene.materials.size())].emission = Rgb(u(3) < 0.5f ? 0 : u(4));
      break;
    case 5:
    case 6:
      instance.world_from_mesh.translation += Vec3d(u(2) - 0.5, u(3) - 0.5, u(4) - 0.5);
      break;
    case 7: {
      const SinCos sc = DetSinCos(6.0 * u(2));
      Affine turn;
      turn.column[0] = {sc.cos, 0, -sc.sin};
      turn.column[2] = {sc.sin, 0, sc.cos};
      const Vec3d translation = instance.world_from_mesh.translation;
      instance.world_from_mesh = turn * instance.world_from_mesh;
      instance.world_from_mesh.translation = translation;
      break;
    }
    case 8:
      if (scene.instances.size() > 3) {
        scene.instances.erase(scene.instances.begin() +
                              static_cast<ptrdiff_t>(pick(1, scene.instances.size())));
      }
      break;
    case 9: {
      Instance copy = instance;
      copy.world_from_mesh.translation += Vec3d(u(2), u(3), u(4));
      if (scene.instances.size() < 12) scene.instances.push_back(copy);
      break;
    }
    case 10:
      scene.environment.sky = u(2) < 0.5f ? Rgb() : Rgb(u(3));
      break;
    case 11:
      for (Material& material : scene.materials) {
        if (material.alpha_mode != AlphaMode::kMask) continue;
        material.alpha_cutoff = u(2) < 0.5f ? 0.5f : 0.0f;  // holes or none
      }
      break;
    case 12:
      settings.light_samples = 1 + static_cast<uint32_t>(pick(2, 8));
      break;
    default:
      settings.seed = pick(2, 2);
      break;
  }
}

TEST(Bake, WithACacheEqualsOneWithout) {
  // A walk through scenes, each bake with what those before left. A few states are met again.
  for (const uint64_t cache_bytes : {kCacheBytes, uint64_t{60'000}}) {
    BakeCache cache(cache_bytes);
    std::vector<std::pair<Scene, RenderSettings>> states = {{TestScene(), SmallSettings()}};
    uint64_t kept = 0;
    for (uint64_t step = 0; step < 60; ++step) {
      const uint64_t random = HashKey(cache_bytes, step);
      auto [scene, settings] = states[step % 5 == 4 ? random % states.size() : states.size() - 1];
      if (step % 5 != 4) {
        Mutate(random, scene, settings);
        if (step % 3 == 0) Mutate(random + 1, scene, settings);
      }
      const Baked cold = BakeIt(scene, settings, nullptr, 1);
      const Baked warm = BakeIt(scene, settings, &cache, 1 + step % 3);
      ASSERT_EQ(cold.hashes, warm.hashes) << "step " << step;
      EXPECT_EQ(cold.stats.counts.at("surfels"), warm.stats.counts.at("surfels"));
      EXPECT_EQ(cold.stats.counts.at("nodes"), warm.stats.counts.at("nodes"));
      EXPECT_LE(cache.size_bytes(), cache_bytes);
      kept += warm.skipped("surfels_kept");
      states.emplace_back(std::move(scene), settings);
    }
    EXPECT_GT(kept, 10'000u);
  }
}

TEST(Bake, DoesOnlyWhatAChangeAffects) {
  const Scene base = TestScene();
  const RenderSettings settings = SmallSettings();
  BakeCache cache(kCacheBytes);
  const Baked first = BakeIt(base, settings, &cache);
  const uint64_t surfels = first.stats.counts.at("surfels");
  EXPECT_EQ(first.skipped("bake_stages"), 0u);
  EXPECT_EQ(first.skipped("surfels_kept"), 0u);

  Scene scene = base;
  scene.cameras[0].eye += Vec3d(1, 0, 0);
  const Baked camera = BakeIt(scene, settings, &cache);
  EXPECT_EQ(camera.hashes, first.hashes);
  EXPECT_EQ(camera.skipped("bake_stages"), 3u);
  EXPECT_EQ(camera.skipped("surfels_shaded_kept"), surfels);

  scene = base;
  scene.lights[0].direction = Normalize(Vec3d(0.5, -1, 0.2));
  const Baked light = BakeIt(scene, settings, &cache);
  EXPECT_EQ(light.hashes.topology, first.hashes.topology);
  EXPECT_NE(light.hashes.radiance, first.hashes.radiance);
  EXPECT_EQ(light.skipped("bake_stages"), 2u);
  EXPECT_EQ(light.skipped("surfels_kept"), surfels);
  EXPECT_EQ(light.stats.counts.count("interior_rays"), 0u);
  EXPECT_GT(light.stats.counts.at("shadow_rays"), 0u);

  scene = base;
  scene.materials[0].base_color *= 0.5f;
  const Baked material = BakeIt(scene, settings, &cache);
  EXPECT_EQ(material.hashes.topology, first.hashes.topology);
  EXPECT_EQ(material.skipped("bake_stages"), 2u);

  // The closed box moves, and moves out of the scene's bounds; the one with holes too.
  for (const size_t which : {1u, 2u}) {
    for (const double shift : {0.05, 20.0}) {
      scene = base;
      scene.instances[scene.instances.size() - which].world_from_mesh.translation.x += shift;
      const Baked moved = BakeIt(scene, settings, &cache);
      EXPECT_NE(moved.hashes.topology, first.hashes.topology);
      EXPECT_EQ(moved.skipped("objects_kept"), base.instances.size());
      EXPECT_EQ(moved.skipped("surfels_kept"), surfels);
    }
  }

  // Another shape, of nearly the same area: its surfels only are drawn again.
  scene = base;
  scene.instances.back().world_from_mesh.column[0] *= 1.001;
  const Baked stretched = BakeIt(scene, settings, &cache);
  EXPECT_EQ(stretched.skipped("objects_kept"), base.instances.size() - 1);
  EXPECT_GT(stretched.skipped("surfels_kept"), surfels * 9 / 10);
}

TEST(Bake, WithoutSkippingLeavesTheCacheAlone) {
  RenderSettings settings = SmallSettings();
  BakeCache cache(kCacheBytes);
  const Baked first = BakeIt(TestScene(), settings, &cache);
  settings.no_skip = true;
  const Baked second = BakeIt(TestScene(), settings, &cache);
  EXPECT_EQ(second.skipped("bake_stages"), 0u);
  EXPECT_EQ(second.skipped("surfels_kept"), 0u);
  EXPECT_EQ(first.hashes, second.hashes);
}

TEST(Bake, ALightWithinAClosedObjectKeepsTheTopology) {
  // The inside of the closed box is dark until a light is put there.
  Scene scene = TestScene();
  const Vec3d inside = scene.instances[scene.instances.size() - 2].world_from_mesh.translation;
  BakeCache cache(kCacheBytes);
  const Baked dark = BakeIt(scene, SmallSettings(), &cache);
  scene.lights.push_back(
      {.kind = PunctualKind::kPoint, .position = inside, .intensity = Rgb(1, 1, 1)});
  const Baked lit = BakeIt(scene, SmallSettings(), &cache);
  EXPECT_EQ(lit.hashes, BakeIt(scene, SmallSettings(), nullptr).hashes);
  EXPECT_EQ(lit.hashes.topology, dark.hashes.topology);
  const auto visible_area = [](const Baked& baked) {
    const auto tree =
        PointTree::FromBlobs(baked.blobs.tree_topology, baked.blobs.tree_radiance).value();
    double area = 0;
    const uint32_t groups = tree->levels() > 1 ? tree->first_group(1) : tree->group_count();
    for (uint32_t g = 0; g < groups; ++g) {
      const NodeGroup surfels = tree->group(g);
      for (uint32_t k = 0; k < kLanes; ++k) area += surfels.front_area[k] + surfels.back_area[k];
    }
    return area;
  };
  // Six squares of 0.2 m.
  EXPECT_NEAR(visible_area(lit) - visible_area(dark), 6 * 0.04, 0.01);
}

TEST(Bake, OneThatIsStoppedLeavesTheCacheSane) {
  RenderSettings settings = SmallSettings();
  settings.points = 20'000;
  Scene scene = TestScene();
  BakeCache cache(kCacheBytes);
  int stopped = 0;
  for (int i = 0; i < 12; ++i) {
    // A new place for an object each time, so that stages are done again; stopped ever later.
    scene.instances.back().world_from_mesh.translation.x += 0.01;
    std::atomic<bool> cancel = i == 0;
    std::thread stopper([&] {
      std::this_thread::sleep_for(std::chrono::milliseconds(4 * i));
      cancel = true;
    });
    Executor executor(2);
    Stats stats;
    BakeOptions options;
    options.cache = &cache;
    options.cancel = &cancel;
    const auto baked = Bake(scene, settings, executor, stats, options);
    stopper.join();
    if (baked.ok()) continue;
    EXPECT_TRUE(absl::IsCancelled(baked.status())) << baked.status();
    ++stopped;
  }
  EXPECT_GE(stopped, 1);
  EXPECT_EQ(BakeIt(scene, settings, &cache).hashes, BakeIt(scene, settings, nullptr).hashes);
}

TEST(Bake, ASpacingGivenHoldsWhateverTheScene) {
  const Scene scene = TestScene();
  Executor executor(1);
  const RenderSettings settings = SmallSettings();
  const auto spacing = SurfelSpacing(scene, settings, executor);
  ASSERT_TRUE(spacing.ok()) << spacing.status();
  EXPECT_GT(*spacing, 0);
  Stats stats;
  BakeOptions options;
  BakeCache cache(kCacheBytes);
  options.cache = &cache;
  options.surfel_spacing_m = *spacing;
  ASSERT_TRUE(Bake(scene, settings, executor, stats, options).ok());
  EXPECT_EQ(stats.counts["surfels"], BakeIt(scene, settings, nullptr).stats.counts["surfels"]);
  // A large object comes: with the spacing held, the others keep their surfels.
  Scene larger = scene;
  larger.instances.push_back(larger.instances.back());
  for (Vec3d& column : larger.instances.back().world_from_mesh.column) column *= 8;
  Stats after;
  ASSERT_TRUE(Bake(larger, settings, executor, after, options).ok());
  EXPECT_EQ(after.skipped["surfels_kept"], stats.counts["surfels"]);
  EXPECT_EQ(BakeIt(larger, settings, &cache).skipped("surfels_kept"), 0u);
}

}  // namespace
}  // namespace farpoint
