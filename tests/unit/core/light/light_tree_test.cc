#include "core/light/light_tree.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>
#include <span>
#include <vector>

#include "tests/unit/core/accel/brute_force.h"

namespace farpoint {
namespace {

constexpr Vec3f kUp{0, 1, 0};

LightBounds PointAt(const Vec3d& p, float power = 1) {
  LightBounds light;
  light.box.Extend(Vec3f(p));
  light.power = power;
  return light;
}

// Chooses among point lights by power cosθ / d².
class Chooser {
 public:
  Chooser(std::vector<LightBounds> lights, LightTree::Emission emission)
      : lights_(std::move(lights)), tree_(lights_, emission) {}

  float WeightOf(uint32_t light, const Vec3f& p, const Vec3f& n) const {
    const LightBounds& l = lights_[light];
    const Vec3f v = l.box.min - p;
    const float d = Length(v);
    if (!(d > 0) || d > l.reach_m) return 0;
    if (-Dot(v, l.axis) / d < l.cos_cone) return 0;
    return l.power * std::max(0.0f, Dot(v, n)) / d / d / d;  // d³ may vanish
  }
  std::optional<LightTree::Choice> Choose(const Vec3f& p, const Vec3f& n, double& u,
                                          LightTree::Cache& cache) const {
    return tree_.Choose(p, n, u, cache, [&](uint32_t block, LightTree::Weights& w) {
      for (uint32_t k = 0; k < LightTree::kWidth; ++k) {
        const uint32_t light = tree_.order()[size_t{block} * LightTree::kWidth + k];
        w[k] = light == LightTree::kNone ? 0 : WeightOf(light, p, n);
      }
    });
  }
  double ProbabilityOf(uint32_t place, const Vec3f& p, const Vec3f& n) const {
    LightTree::Cache cache;
    return tree_.ProbabilityOf(place, p, n, cache, [&](uint32_t block, LightTree::Weights& w) {
      for (uint32_t k = 0; k < LightTree::kWidth; ++k) {
        const uint32_t light = tree_.order()[size_t{block} * LightTree::kWidth + k];
        w[k] = light == LightTree::kNone ? 0 : WeightOf(light, p, n);
      }
    });
  }
  const LightTree& tree() const { return tree_; }
  const std::vector<LightBounds>& lights() const { return lights_; }

 private:
  std::vector<LightBounds> lights_;
  LightTree tree_;
};

std::vector<LightBounds> Cloud(size_t count, uint64_t seed, double scale = 1) {
  TestRandom random(seed);
  std::vector<LightBounds> lights;
  for (size_t i = 0; i < count; ++i) {
    lights.push_back(
        PointAt(Vec3d(random.Uniform(-1, 1), random.Uniform(0, 1), random.Uniform(-1, 1)) * scale,
                static_cast<float>(std::exp2(random.Uniform(-8, 8)))));
  }
  return lights;
}

TEST(LightTree, HoldsEveryLightOnce) {
  for (const size_t count : {1u, 7u, 8u, 9u, 64u, 65u, 1000u}) {
    const LightTree tree(Cloud(count, count), LightTree::Emission::kCone);
    std::multiset<uint32_t> found;
    for (const uint32_t i : tree.order()) {
      if (i != LightTree::kNone) found.insert(i);
    }
    EXPECT_EQ(found.size(), count);
    EXPECT_EQ(std::set<uint32_t>(found.begin(), found.end()).size(), count);
    EXPECT_EQ(*found.rbegin(), count - 1);
    EXPECT_EQ(tree.order().size() % LightTree::kWidth, 0u);
  }
  EXPECT_TRUE(LightTree().empty());
}

// Σ over u of 1/probability · [light = i] estimates 1 for every light that can send anything.
TEST(LightTree, ProbabilitiesAreThoseOfTheDraws) {
  const Chooser chooser(Cloud(100, 3), LightTree::Emission::kCone);
  const Vec3f p(0.2f, 0.1f, -0.3f);
  constexpr int kDraws = 1 << 18;
  std::map<uint32_t, int> hits;
  std::map<uint32_t, double> probability;
  LightTree::Cache cache;
  for (int i = 0; i < kDraws; ++i) {
    double u = (i + 0.5) / kDraws;
    const auto choice = chooser.Choose(p, kUp, u, cache);
    ASSERT_TRUE(choice.has_value());
    EXPECT_TRUE(u >= 0 && u < 1);
    const uint32_t light = chooser.tree().order()[choice->place];
    ++hits[light];
    const auto [it, is_new] = probability.emplace(light, choice->probability);
    EXPECT_EQ(it->second, choice->probability);
  }
  double total = 0;
  for (const auto& [light, count] : hits) {
    // One draw per step of the grid, up to the ends of the interval.
    EXPECT_NEAR(count, probability[light] * kDraws, 2.0) << light;
    total += probability[light];
  }
  EXPECT_NEAR(total, 1, 1e-3);
  for (uint32_t i = 0; i < 100; ++i) {
    // Those that are left out send less than a draw's worth.
    if (hits[i] == 0) {
      EXPECT_LT(chooser.WeightOf(i, p, kUp), 1e-3f * 256);
    }
  }
}

// What rescaling leaves of u is spread evenly, so that it can place a point.
TEST(LightTree, WhatIsLeftOfTheNumberIsUniform) {
  const Chooser chooser(Cloud(50, 4), LightTree::Emission::kCone);
  constexpr int kDraws = 1 << 16;
  double sum = 0, square = 0;
  LightTree::Cache cache;
  for (int i = 0; i < kDraws; ++i) {
    double u = (i + 0.5) / kDraws;
    ASSERT_TRUE(chooser.Choose({0, 0, 0}, kUp, u, cache).has_value());
    sum += u;
    square += u * u;
  }
  EXPECT_NEAR(sum / kDraws, 0.5, 2e-3);
  EXPECT_NEAR(square / kDraws, 1.0 / 3, 2e-3);
}

// A light that can send something is never out of reach, whatever cones, ranges and horizons say.
TEST(LightTree, NothingThatArrivesIsCulled) {
  TestRandom random(5);
  for (int round = 0; round < 30; ++round) {
    std::vector<LightBounds> lights = Cloud(200, static_cast<uint64_t>(round));
    for (LightBounds& light : lights) {
      light.power = 1;
      light.axis = Vec3f(random.Direction());
      light.cos_cone = static_cast<float>(random.Uniform(0.7, 1));
      light.reach_m = static_cast<float>(random.Uniform(0.1, 1));
    }
    const Chooser chooser(lights, LightTree::Emission::kCone);
    for (int i = 0; i < 20; ++i) {
      const Vec3f p(Vec3d(random.Uniform(-1, 1), random.Uniform(-1, 1), random.Uniform(-1, 1)));
      const Vec3f n(random.Direction());
      std::set<uint32_t> arriving, drawn;
      for (uint32_t k = 0; k < lights.size(); ++k) {
        if (chooser.WeightOf(k, p, n) > 0) arriving.insert(k);
      }
      LightTree::Cache cache;
      for (int s = 0; s < 20000 && drawn.size() < arriving.size(); ++s) {
        double u = random.Uniform();
        const auto choice = chooser.Choose(p, n, u, cache);
        if (choice) drawn.insert(chooser.tree().order()[choice->place]);
      }
      EXPECT_EQ(arriving, drawn);
    }
  }
}

TEST(LightTree, IsTheSameAtEveryScale) {
  const Chooser one(Cloud(300, 6), LightTree::Emission::kCone);
  for (const double scale : {0x1p-20, 0x1p17}) {
    const Chooser other(Cloud(300, 6, scale), LightTree::Emission::kCone);
    ASSERT_TRUE(std::ranges::equal(one.tree().order(), other.tree().order()));
    TestRandom random(7);
    for (int i = 0; i < 500; ++i) {
      const Vec3d p(random.Uniform(-1, 1), random.Uniform(0, 1), random.Uniform(-1, 1));
      const Vec3f n(random.Direction());
      double u = random.Uniform(), v = u;
      LightTree::Cache a, b;
      const auto x = one.Choose(Vec3f(p), n, u, a);
      const auto y = other.Choose(Vec3f(p * scale), n, v, b);
      ASSERT_EQ(x.has_value(), y.has_value());
      if (!x) continue;
      EXPECT_EQ(x->place, y->place);
      EXPECT_EQ(x->probability, y->probability);
      EXPECT_EQ(u, v);
    }
  }
}

TEST(LightTree, TheCacheChangesNothing) {
  const Chooser chooser(Cloud(2000, 8), LightTree::Emission::kTwoSidedCosine);
  TestRandom random(9);
  LightTree::Cache kept;
  for (int i = 0; i < 2000; ++i) {
    double u = random.Uniform(), v = u;
    LightTree::Cache fresh;
    const auto a = chooser.Choose({0.1f, 0, 0.1f}, kUp, u, kept);
    const auto b = chooser.Choose({0.1f, 0, 0.1f}, kUp, v, fresh);
    ASSERT_EQ(a.has_value(), b.has_value());
    if (!a) continue;
    EXPECT_EQ(a->place, b->place);
    EXPECT_EQ(a->probability, b->probability);
    EXPECT_EQ(u, v);
  }
}

TEST(LightTree, EightPointsChooseInABlockLikeEachAlone) {
  TestRandom random(12);
  for (size_t count = 1; count <= LightTree::kWidth; ++count) {
    EXPECT_TRUE(LightTree(Cloud(count, 1), LightTree::Emission::kCone).is_one_block());
    for (int i = 0; i < 500; ++i) {
      std::array<F8, LightTree::kWidth> weights{};
      U8 bits;
      for (size_t k = 0; k < 8; ++k) {
        for (size_t light = 0; light < count; ++light) {
          const double w = random.Uniform() < 0.4 ? 0.0 : std::exp2(random.Uniform(-20, 20));
          weights[light][k] = static_cast<float>(w);
        }
        bits[k] = k == 0 ? 0u : k == 1 ? ~0u : static_cast<uint32_t>(random.Uniform() * 0x1p32);
      }
      const LightTree::Choices8 choices =
          LightTree::ChooseInBlock8(std::span(weights).first(count), bits);
      for (size_t k = 0; k < 8; ++k) {
        LightTree::Weights own;
        for (size_t light = 0; light < LightTree::kWidth; ++light) own[light] = weights[light][k];
        double u = bits[k] * 0x1p-32;
        const auto choice = LightTree::ChooseInBlock(own, u);
        ASSERT_EQ((Bits8(choices.any) >> k & 1u) != 0, choice.has_value());
        ASSERT_LT(choices.place[k], LightTree::kWidth);
        if (!choice) continue;
        ASSERT_EQ(choices.place[k], choice->place);
        ASSERT_EQ(choices.probability[k], static_cast<float>(choice->probability));
        ASSERT_EQ(choices.u[k], static_cast<float>(u));
      }
    }
  }
  EXPECT_FALSE(LightTree(Cloud(9, 1), LightTree::Emission::kCone).is_one_block());
  EXPECT_FALSE(LightTree().is_one_block());
}

TEST(LightTree, ManyLightsInOnePlaceAndAtThePointAreFinite) {
  std::vector<LightBounds> lights(100, PointAt({1, 1, 1}));
  for (int i = 0; i < 100; ++i) lights.push_back(PointAt({std::exp2(-i), 0.5, 0}));
  const Chooser chooser(lights, LightTree::Emission::kCone);
  for (const Vec3f& p : {Vec3f(1, 1, 1), Vec3f(0, 0, 0), Vec3f(0, 0.5f, 0), Vec3f(9, -9, 9)}) {
    LightTree::Cache cache;
    for (int i = 0; i < 200; ++i) {
      double u = (i + 0.5) / 200;
      const auto choice = chooser.Choose(p, kUp, u, cache);
      if (!choice) continue;
      EXPECT_TRUE(choice->probability > 0 && choice->probability <= 1.0000001);
      EXPECT_GT(chooser.WeightOf(chooser.tree().order()[choice->place], p, kUp), 0);
    }
  }
}

// Of one block, of two levels, of many.
TEST(LightTree, ProbabilityIsThatOfChoosing) {
  for (const size_t count : {1, 2, 7, 60, 1000}) {
    const Chooser chooser(Cloud(count, count), LightTree::Emission::kCone);
    for (const Vec3f& p : {Vec3f(0.1f, 0, 0.2f), Vec3f(-3, -2, 1)}) {
      double all = 0;
      for (uint32_t place = 0; place < chooser.tree().order().size(); ++place) {
        if (chooser.tree().order()[place] != LightTree::kNone) {
          all += chooser.ProbabilityOf(place, p, kUp);
        }
      }
      LightTree::Cache cache;
      uint32_t chosen = 0;
      for (int i = 0; i < 64; ++i) {
        double u = (i + 0.5) / 64;
        const auto choice = chooser.Choose(p, kUp, u, cache);
        if (!choice) continue;
        ++chosen;
        EXPECT_DOUBLE_EQ(chooser.ProbabilityOf(choice->place, p, kUp), choice->probability);
      }
      if (chosen == 64) EXPECT_NEAR(all, 1, 1e-9) << count;
    }
  }
}

}  // namespace
}  // namespace farpoint
