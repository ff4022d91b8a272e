// The pixels are a function of scene, settings and version: of nothing else.
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "tests/integration/farm.h"

namespace farpoint {
namespace {

// Small, but with five by four blocks, an uneven right and lower edge, and more than one tile.
const PixelRect kCrop{21, 33, 101, 90};

std::vector<std::string> Scene(const std::string& integrator) {
  return {SceneFile("cornell.gltf"),
          "--resolution",
          "150x118",
          "--points",
          "3000",
          "--light-samples",
          "2",
          "--paths",
          "4",
          "--clusters",
          "8",
          "--microbuffer",
          "8",
          "--aov",
          "irradiance",
          "--integrator",
          integrator,
          "--quiet"};
}

std::vector<std::string> operator+(std::vector<std::string> a, const std::vector<std::string>& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

class Determinism : public testing::TestWithParam<std::string> {
 protected:
  // Renders with `verb`; fails the test unless that worked.
  std::string Render(const std::vector<std::string>& verb, const std::vector<std::string>& flags) {
    const std::string output = farm_.File("image" + std::to_string(images_++) + ".exr");
    const RunResult result = farm_.Client(verb + Scene(GetParam()) + flags + Output(output));
    EXPECT_EQ(result.exit_code, 0) << result.err << farm_.Logs();
    return output;
  }
  static std::vector<std::string> Output(const std::string& file) { return {"-o", file}; }

  Farm farm_;
  int images_ = 0;
};

TEST_P(Determinism, OneHashForAllWorkersThreadsTilesAndCropsEmbeddedAndFarmed) {
  const std::vector<std::string> embedded = {"render"};
  const std::string reference =
      Render(embedded, {"--workers", "1", "--threads", "1", "--tile", "128"});
  const std::string whole = ImageHashOf(reference);
  ASSERT_FALSE(whole.empty());
  const std::string crop = CropHashOf(reference, kCrop);
  ASSERT_NE(crop, whole);
  const std::vector<std::string> crop_flags = {"--crop", "21,33,101,90"};

  for (const char* workers : {"1", "2", "3"}) {
    for (const char* threads : {"1", "2"}) {
      for (const char* tile : {"32", "64", "128"}) {
        SCOPED_TRACE(std::string("embedded, workers ") + workers + ", threads " + threads +
                     ", tile " + tile);
        const std::vector<std::string> flags = {"--workers", workers,  "--threads",
                                                threads,     "--tile", tile};
        EXPECT_EQ(ImageHashOf(Render(embedded, flags)), whole);
        EXPECT_EQ(ImageHashOf(Render(embedded, flags + crop_flags)), crop);
      }
    }
  }

  farm_.StartServer();
  if (HasFatalFailure()) return;
  const std::vector<std::string> farmed = farm_.WithCoordinator({"submit"});
  for (const int threads : {1, 2}) {
    for (const int workers : {1, 2, 3}) {
      farm_.StartWorker(threads);
      for (const char* tile : {"32", "64", "128"}) {
        SCOPED_TRACE("farmed, workers " + std::to_string(workers) + ", threads " +
                     std::to_string(threads) + ", tile " + tile);
        EXPECT_EQ(ImageHashOf(Render(farmed, {"--tile", tile})), whole);
        EXPECT_EQ(
            ImageHashOf(Render(farmed, crop_flags + std::vector<std::string>{"--tile", tile})),
            crop);
      }
    }
    farm_.StopWorkers();
  }
}

INSTANTIATE_TEST_SUITE_P(Integrators, Determinism, testing::Values("fpbgi", "pbgi", "pt"),
                         [](const auto& info) { return info.param; });

TEST(DeterminismOfFiles, EqualImagesAreEqualFiles) {
  Farm farm;
  for (const char* name : {"a.exr", "b.exr"}) {
    const RunResult result = farm.Client(
        std::vector<std::string>{"render"} + Scene("fpbgi") +
        std::vector<std::string>{"-o", farm.File(name), "--tile", name[0] == 'a' ? "32" : "64"});
    ASSERT_EQ(result.exit_code, 0) << result.err;
  }
  EXPECT_EQ(farm.Read("a.exr"), farm.Read("b.exr"));
}

TEST(DeterminismOfSeeds, AnotherSeedIsAnotherImage) {
  Farm farm;
  std::string hashes[2];
  for (const char* seed : {"0", "1"}) {
    const std::string output = farm.File(std::string(seed) + ".exr");
    const RunResult result =
        farm.Client(std::vector<std::string>{"render"} + Scene("fpbgi") +
                    std::vector<std::string>{"-o", output, "--seed", seed, "--crop", "0,0,64,64"});
    ASSERT_EQ(result.exit_code, 0) << result.err;
    hashes[seed[0] - '0'] = ImageHashOf(output);
  }
  EXPECT_NE(hashes[0], hashes[1]);
}

}  // namespace
}  // namespace farpoint
