#include "core/scene/environment_image.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "core/base/executor.h"
#include "core/math/elementary.h"
#include "core/math/half.h"
#include "core/math/sampling.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {
namespace {

// An uncompressed OpenEXR file of scanlines, byte by byte (OpenEXR's "File Layout").
class ExrFile {
 public:
  ExrFile(int width, int height) : width_(width), height_(height) {}
  // Channels are given in the order of their names, as the file has them.
  void Add(const std::string& name, bool half, std::vector<float> values) {
    channels_.push_back({name, half, std::move(values)});
  }
  void Window(int x0, int y0) {
    x0_ = x0;
    y0_ = y0;
  }
  void Attribute(const std::string& name, const std::string& type, const std::string& value) {
    extra_ += name + '\0' + type + '\0' + Bytes(static_cast<int32_t>(value.size())) + value;
  }
  template <typename T>
  static std::string Bytes(const T& value) {
    return {reinterpret_cast<const char*>(&value), sizeof(value)};
  }
  Blob Encode() const {
    std::string out = Bytes(int32_t{20000630}) + Bytes(int32_t{2});
    const auto attribute = [&](const std::string& name, const std::string& type,
                               const std::string& value) {
      out += name + '\0' + type + '\0' + Bytes(static_cast<int32_t>(value.size())) + value;
    };
    std::string list;
    for (const Channel& c : channels_) {
      list += c.name + '\0' + Bytes(int32_t{c.half ? 1 : 2}) + Bytes(int32_t{0}) +
              Bytes(int32_t{1}) + Bytes(int32_t{1});
    }
    attribute("channels", "chlist", list + '\0');
    attribute("compression", "compression", std::string(1, '\0'));
    const std::array<int32_t, 4> window{x0_, y0_, x0_ + width_ - 1, y0_ + height_ - 1};
    attribute("dataWindow", "box2i", Bytes(window));
    attribute("displayWindow", "box2i", Bytes(std::array<int32_t, 4>{0, 0, 99, 49}));
    attribute("lineOrder", "lineOrder", std::string(1, '\0'));
    attribute("pixelAspectRatio", "float", Bytes(1.0f));
    attribute("screenWindowCenter", "v2f", Bytes(std::array<float, 2>{0, 0}));
    attribute("screenWindowWidth", "float", Bytes(1.0f));
    out += extra_ + '\0';
    std::string lines;
    const size_t first = out.size() + sizeof(uint64_t) * static_cast<size_t>(height_);
    for (int y = 0; y < height_; ++y) {
      out += Bytes(static_cast<uint64_t>(first + lines.size()));
      std::string row;
      for (const Channel& c : channels_) {
        for (int x = 0; x < width_; ++x) {
          const float v = c.values[static_cast<size_t>(y * width_ + x)];
          row += c.half ? Bytes(HalfBits(v)) : Bytes(v);
        }
      }
      lines += Bytes(int32_t{y0_ + y}) + Bytes(static_cast<int32_t>(row.size())) + row;
    }
    return Blob::FromString(out + lines);
  }

 private:
  static uint16_t HalfBits(float v) {
    if (std::isinf(v)) return v > 0 ? 0x7c00 : 0xfc00;
    return FloatToHalf(v);
  }
  struct Channel {
    std::string name;
    bool half;
    std::vector<float> values;
  };
  int width_, height_, x0_ = 0, y0_ = 0;
  std::vector<Channel> channels_;
  std::string extra_;
};

ExrFile Rgb2x1(bool half, const std::array<float, 6>& v) {
  ExrFile file(2, 1);
  file.Add("B", half, {v[2], v[5]});
  file.Add("G", half, {v[1], v[4]});
  file.Add("R", half, {v[0], v[3]});
  return file;
}

void ExpectRefused(const Blob& file, const std::string& text) {
  Environment environment;
  environment.map_width = 7;
  environment.map = {Rgb(3)};
  const absl::Status status = LoadEnvironmentMap(file, "sky.exr", environment);
  ASSERT_FALSE(status.ok()) << text;
  EXPECT_NE(status.message().find(text), std::string::npos) << status;
  EXPECT_NE(status.message().find("sky.exr"), std::string::npos) << status;
  EXPECT_EQ(environment.map_width, 7u);
  EXPECT_EQ(environment.map.size(), 1u);
}

TEST(EnvironmentMap, ReadsHalvesAndFloatsInAnyWindow) {
  for (const bool half : {true, false}) {
    ExrFile file = Rgb2x1(half, {1, 2, 3, 0.5f, 60000, 0});
    file.Window(-5, 40);
    Environment environment;
    environment.sky = Rgb(9);
    ASSERT_TRUE(LoadEnvironmentMap(file.Encode(), "sky.exr", environment).ok());
    EXPECT_EQ(environment.map_width, 2u);
    EXPECT_EQ(environment.map_height, 1u);
    EXPECT_EQ(environment.map, (std::vector<Rgb>{{1, 2, 3}, {0.5f, 60000, 0}}));
    EXPECT_EQ(environment.sky, Rgb(9));
  }
}

TEST(EnvironmentMap, ReadsLuminanceAlone) {
  ExrFile file(1, 2);
  file.Add("Y", false, {0.25f, 8e9f});
  Environment environment;
  ASSERT_TRUE(LoadEnvironmentMap(file.Encode(), "sky.exr", environment).ok());
  EXPECT_EQ(environment.map, (std::vector<Rgb>{Rgb(0.25f), Rgb(8e9f)}));
}

TEST(EnvironmentMap, OtherPrimariesAreConvertedAndWhiteStaysWhite) {
  // ACES AP0.
  const std::array<float, 8> ap0{0.7347f, 0.2653f,  0.0f,     1.0f,
                                 0.0001f, -0.0770f, 0.32168f, 0.33767f};
  ExrFile file = Rgb2x1(false, {5, 5, 5, 0, 1, 0});
  file.Attribute("chromaticities", "chromaticities", ExrFile::Bytes(ap0));
  Environment environment;
  ASSERT_TRUE(LoadEnvironmentMap(file.Encode(), "sky.exr", environment).ok());
  for (int c = 0; c < 3; ++c) EXPECT_NEAR(environment.map[0][c], 5, 1e-4f);
  EXPECT_GT(environment.map[1].y, 1.2f);
  // Of green outside Rec. 709 nothing negative is left.
  EXPECT_EQ(environment.map[1].x, 0);
}

TEST(EnvironmentMap, PrimariesWithoutColoursAreRefused) {
  for (const std::array<float, 8>& primaries :
       {std::array<float, 8>{},
        std::array<float, 8>{0.3f, 0.3f, 0.3f, 0.3f, 0.3f, 0.3f, 0.3f, 0.3f},
        std::array<float, 8>{0.6f, 0.3f, 0.3f, 0.6f, 0.1f, 0.1f, 0.0f, 0.0f}}) {
    ExrFile file = Rgb2x1(false, {5, 5, 5, 0, 1, 0});
    file.Attribute("chromaticities", "chromaticities", ExrFile::Bytes(primaries));
    Environment environment;
    const absl::Status status = LoadEnvironmentMap(file.Encode(), "sky.exr", environment);
    if (!status.ok()) continue;
    // OpenEXR makes something of some: then it is light.
    for (const Rgb& texel : environment.map) EXPECT_TRUE(IsFinite(texel));
  }
  const std::array<float, 8> point{0.3f, 0.3f, 0.3f, 0.3f, 0.3f, 0.3f, 0.3f, 0.3f};
  ExrFile file = Rgb2x1(false, {5, 5, 5, 0, 1, 0});
  file.Attribute("chromaticities", "chromaticities", ExrFile::Bytes(point));
  ExpectRefused(file.Encode(), "sky.exr");
}

TEST(EnvironmentMap, NegativeIsBlackAndWhatIsNotFiniteIsRefused) {
  Environment environment;
  ASSERT_TRUE(LoadEnvironmentMap(Rgb2x1(false, {-1, -0.0f, 2, 3, -1e9f, 4}).Encode(), "sky.exr",
                                 environment)
                  .ok());
  EXPECT_EQ(environment.map, (std::vector<Rgb>{{0, 0, 2}, {3, 0, 4}}));
  EXPECT_FALSE(std::signbit(environment.map[0].y));
  constexpr float kInf = std::numeric_limits<float>::infinity();
  constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
  ExpectRefused(Rgb2x1(false, {1, 1, 1, 1, kNan, 1}).Encode(), "column 1, row 0 is not finite");
  ExpectRefused(Rgb2x1(true, {kInf, 1, 1, 1, 1, 1}).Encode(), "column 0, row 0 is not finite");
  ExpectRefused(Rgb2x1(false, {1, 1, 1, 1, 1, 2e15f}).Encode(), "beyond 1e15");
}

TEST(EnvironmentMap, WhatIsNoLatLongMapIsRefused) {
  ExrFile cube = Rgb2x1(false, {1, 1, 1, 1, 1, 1});
  cube.Attribute("envmap", "envmap", std::string(1, '\1'));
  ExpectRefused(cube.Encode(), "cube map");
  ExrFile lat_long = Rgb2x1(false, {1, 1, 1, 1, 1, 1});
  lat_long.Attribute("envmap", "envmap", std::string(1, '\0'));
  Environment environment;
  EXPECT_TRUE(LoadEnvironmentMap(lat_long.Encode(), "sky.exr", environment).ok());
  ExrFile no_red(1, 1);
  no_red.Add("B", false, {1});
  no_red.Add("G", false, {1});
  ExpectRefused(no_red.Encode(), "no channel R");
  ExpectRefused(Blob::FromString("\x89PNG"), "not an OpenEXR file");
  ExpectRefused(Blob(), "");
}

TEST(EnvironmentMap, DamagedFilesAreRefused) {
  const std::string good([] {
    const Blob blob = Rgb2x1(true, {1, 2, 3, 4, 5, 6}).Encode();
    return std::string(reinterpret_cast<const char*>(blob.bytes().data()), blob.size());
  }());
  for (size_t size = 0; size < good.size(); ++size) {
    Environment environment;
    EXPECT_FALSE(
        LoadEnvironmentMap(Blob::FromString(good.substr(0, size)), "sky.exr", environment).ok())
        << size;
  }
  for (size_t i = 0; i < good.size(); ++i) {
    for (const char flip : {'\1', '\x80', '\xff'}) {
      std::string bad = good;
      bad[i] = static_cast<char>(bad[i] ^ flip);
      Environment environment;
      static_cast<void>(LoadEnvironmentMap(Blob::FromString(bad), "sky.exr", environment));
    }
  }
  // A header that announces more than the limit: refused before anything is allocated.
  const int32_t most[4] = {0, 0, 65535, 1024};
  std::string huge = good;
  const size_t at = huge.find("dataWindow") + 11 + 6 + 4;
  std::memcpy(huge.data() + at, most, sizeof(most));
  huge.resize(huge.size() + 8 * 1025);  // for the table of lines, which is read first
  ExpectRefused(Blob::FromString(huge), "65536x1025");
}

// --- Radiance pictures ---

constexpr char kHdrHead[] = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n";

std::string Rgbe(int r, int g, int b, int e) {
  return {static_cast<char>(r), static_cast<char>(g), static_cast<char>(b), static_cast<char>(e)};
}

TEST(EnvironmentMap, ReadsRadiancePictures) {
  // 128 / 256 · 2^(e - 128).
  std::string flat = kHdrHead;
  flat += "EXPOSURE=2\n\n-Y 1 +X 3\n" + Rgbe(128, 64, 0, 130) + Rgbe(255, 255, 255, 0) +
          Rgbe(128, 128, 128, 120);
  Environment environment;
  ASSERT_TRUE(LoadEnvironmentMap(Blob::FromString(flat), "sky.hdr", environment).ok());
  EXPECT_EQ(environment.map, (std::vector<Rgb>{{1, 0.5f, 0}, Rgb(0), Rgb(0x1p-10f)}));

  // Runs of the old kind: two more of the same, then 256 · 0 + …
  std::string old = kHdrHead;
  old += "\n-Y 1 +X 4\n" + Rgbe(128, 128, 128, 129) + Rgbe(1, 1, 1, 2) + Rgbe(128, 0, 0, 129);
  ASSERT_TRUE(LoadEnvironmentMap(Blob::FromString(old), "sky.hdr", environment).ok());
  EXPECT_EQ(environment.map, (std::vector<Rgb>{Rgb(1), Rgb(1), Rgb(1), {1, 0, 0}}));

  // Channel by channel: a run, and values as they stand.
  std::string rle = kHdrHead;
  rle += "\n-Y 1 +X 8\n" + Rgbe(2, 2, 0, 8);
  rle += std::string("\x88\x80", 2);                      // R: 8 times 128
  rle += std::string("\x04\x00\x40\x80\xc0\x84\x00", 7);  // G: 0 64 128 192, 4 times 0
  rle += std::string("\x88\x00", 2);
  rle += std::string("\x88\x81", 2);  // exponent 129
  ASSERT_TRUE(LoadEnvironmentMap(Blob::FromString(rle), "sky.hdr", environment).ok());
  ASSERT_EQ(environment.map.size(), 8u);
  EXPECT_EQ(environment.map[0], Rgb(1, 0, 0));
  EXPECT_EQ(environment.map[3], Rgb(1, 1.5f, 0));
  EXPECT_EQ(environment.map[7], Rgb(1, 0, 0));
  for (size_t size = 0; size < rle.size(); ++size) {
    EXPECT_FALSE(
        LoadEnvironmentMap(Blob::FromString(rle.substr(0, size)), "sky.hdr", environment).ok());
  }
}

TEST(EnvironmentMap, BadRadiancePicturesAreRefused) {
  const std::string head = kHdrHead, row = Rgbe(1, 2, 3, 128);
  const std::pair<std::string, std::string> cases[] = {
      {"#?RADIANCE\n\n-Y 1 +X 1\n" + row, "32-bit_rle_rgbe"},
      {head + "\n+X 1 -Y 1\n" + row, "standard orientation"},
      {head + "\n-Y 0 +X 1\n" + row, "standard orientation"},
      {head + "\n-Y 65536 +X 65536\n" + row, "make it smaller"},
      {head + "\n-Y 9000 +X 1000\n" + row, "row 0 of 9000"},
      {head + "EXPOSURE=0\n\n-Y 1 +X 1\n" + row, "EXPOSURE"},
      {head + "\n-Y 1 +X 2\n" + Rgbe(1, 1, 1, 2), "row 0"},  // a run of nothing
      {head + "\n-Y 1 +X 8\n" + Rgbe(2, 2, 0, 8) + std::string(8, '\0'), "row 0"},
      {head, "header"}};
  for (const auto& [file, text] : cases) {
    Environment environment;
    const absl::Status status = LoadEnvironmentMap(Blob::FromString(file), "sky.hdr", environment);
    EXPECT_TRUE(absl::IsInvalidArgument(status)) << text;
    EXPECT_NE(status.message().find(text), std::string::npos) << status;
  }
}

// --- Orientation ---

// The first row's middle is straight up; the centre of the image is +z, its left quarter +x.
TEST(EnvironmentMap, DirectionsAreOpenExrs) {
  Scene scene;
  Environment& e = scene.environment;
  e.map_width = 8;
  e.map_height = 4;
  for (int i = 0; i < 32; ++i) e.map.push_back(Rgb(static_cast<float>(i), 0, 1));
  Executor executor(1);
  const auto at = [&](const Vec3f& w) {
    return (*PreparedScene::Prepare(scene, executor))->EnvironmentRadiance(w).x;
  };
  const auto direction = [](double x, double y) {
    const double longitude = kPi * (1 - 2 * x / 8), latitude = kPi * (0.5 - y / 4);
    return Vec3f(Vec3d(std::sin(longitude) * std::cos(latitude), std::sin(latitude),
                       std::cos(longitude) * std::cos(latitude)));
  };
  for (int y = 0; y < 4; ++y) {
    for (int x = 0; x < 8; ++x) {
      EXPECT_NEAR(at(direction(x + 0.5, y + 0.5)), y * 8 + x, 1e-4);
      if (x < 7) {
        EXPECT_NEAR(at(direction(x + 1.0, y + 0.5)), y * 8 + x + 0.5, 1e-4);
      }
    }
    EXPECT_NEAR(at(direction(8, y + 0.5)), y * 8 + 3.5, 1e-3);  // around
  }
  EXPECT_NEAR(at({0, 0, 1}), 15.5, 1e-4);
  EXPECT_NEAR(at({1, 0, 0}), 13.5, 1e-4);
  EXPECT_NEAR(at({-1, 0, 0}), 17.5, 1e-4);
  EXPECT_LE(at({0, 1, 0}), 7);
  EXPECT_GE(at({0, -1, 0}), 24);

  // Turned by 90° from above, counter-clockwise: what was at +z is seen at +x.
  ASSERT_TRUE(OrientEnvironmentMap({0, 1, 0}, 90, e).ok());
  EXPECT_NEAR(at({1, 0, 0}), 15.5, 1e-4);
  EXPECT_NEAR(at({0, 0, -1}), 13.5, 1e-4);
  // Up along z, as other programs have it: the top row is there.
  ASSERT_TRUE(OrientEnvironmentMap({0, 0, 5}, 0, e).ok());
  EXPECT_LE(at({0, 0, 1}), 7);
  EXPECT_GE(at({0, 0, -1}), 24);
  EXPECT_NEAR(at({0, -1, 0}), 15.5, 1e-4);
  EXPECT_NEAR(at({1, 0, 0}), 13.5, 1e-4);
}

TEST(EnvironmentMap, OrientationIsARotationWhateverTheUp) {
  uint64_t state = 3;
  const auto uniform = [&](double a, double b) {
    state = Mix64(state);
    return a + (b - a) * static_cast<double>(state >> 11) * 0x1p-53;
  };
  for (int i = 0; i < 200; ++i) {
    Environment e;
    const Vec3d up = i == 0   ? Vec3d(0, -1, 0)
                     : i == 1 ? Vec3d(1e-9, -1, 0)
                              : Vec3d(uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)) *
                                    std::exp2(uniform(-50, 50));
    const double rotation = i == 2 ? 1e9 : uniform(-720, 720);
    ASSERT_TRUE(OrientEnvironmentMap(up, rotation, e).ok());
    const auto& a = e.world_from_map;
    EXPECT_NEAR(Length(a[0]), 1, 1e-9);
    EXPECT_NEAR(Dot(a[0], a[1]), 0, 1e-9);
    EXPECT_LT(Length(Cross(a[0], a[1]) - a[2]), 1e-9);
    EXPECT_LT(Length(a[1] - up / Length(up)), 1e-9);
  }
  Environment e;
  EXPECT_FALSE(OrientEnvironmentMap({0, 0, 0}, 0, e).ok());
  EXPECT_FALSE(OrientEnvironmentMap({0, NAN, 1}, 0, e).ok());
  EXPECT_FALSE(OrientEnvironmentMap({0, 1, 0}, INFINITY, e).ok());
}

}  // namespace
}  // namespace farpoint
