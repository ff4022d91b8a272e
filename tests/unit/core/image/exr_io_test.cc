#include "core/image/exr_io.h"

#include <gtest/gtest.h>

#include <cstring>
#include <random>

#include "core/base/blob.h"
#include "tests/unit/core/image/image_testing.h"

namespace farpoint {
namespace {

class ExrIo : public ImageFiles {
 protected:
  std::vector<std::byte> FileBytes(const std::string& name) const {
    const absl::StatusOr<Blob> blob = ReadFile(Path(name));
    EXPECT_TRUE(blob.ok()) << blob.status();
    return {blob->bytes().begin(), blob->bytes().end()};
  }
  absl::StatusOr<ExrImage> ReadBytes(std::span<const std::byte> bytes) const {
    WriteRaw("bytes.exr", {reinterpret_cast<const char*>(bytes.data()), bytes.size()});
    return ReadExr(Path("bytes.exr"));
  }
};

TEST_F(ExrIo, RoundTripsEveryLayerAndCropBitByBit) {
  for (const ExrCompression compression :
       {ExrCompression::kNone, ExrCompression::kRle, ExrCompression::kZips, ExrCompression::kZip,
        ExrCompression::kPiz}) {
    EXPECT_TRUE(IsLossless(compression));
    for (const PixelRect rect : {PixelRect{0, 0, 100, 70}, PixelRect{37, 5, 99, 70},
                                 PixelRect{99, 69, 100, 70}, PixelRect{0, 31, 100, 33}}) {
      const Film film = TestFilm(rect, EveryLayer());
      const absl::Status written = WriteExr(Path("f.exr"), film, 100, 70, {}, compression);
      ASSERT_TRUE(written.ok()) << written;
      EXPECT_FALSE(std::filesystem::exists(Path("f.exr.part")));
      const absl::StatusOr<ExrImage> image = ReadExr(Path("f.exr"));
      ASSERT_TRUE(image.ok()) << image.status();
      EXPECT_EQ(image->data_window, rect);
      EXPECT_EQ(image->frame_width, 100);
      EXPECT_EQ(image->frame_height, 70);
      const absl::StatusOr<Film> back = FilmFromExr(*image);
      ASSERT_TRUE(back.ok()) << back.status();
      EXPECT_TRUE(SameFilm(*back, film));
      EXPECT_EQ(ImageHash(*back), ImageHash(film));
    }
  }
}

// Smooth colours, as images are.
Film SmoothFilm() {
  Film film({0, 0, 128, 96}, {Layer::kBeauty, Layer::kDepth});
  for (int y = 0; y < 96; ++y) {
    for (int x = 0; x < 128; ++x) {
      const float u = static_cast<float>(x) / 128, v = static_cast<float>(y) / 96;
      const float colour[4] = {0.1f + u, 0.2f + u * v, 0.5f + v * v, 1};
      const float depth[1] = {1 + 7 * u + v};
      film.Set(Layer::kBeauty, x, y, colour);
      film.Set(Layer::kDepth, x, y, depth);
    }
  }
  film.RoundToStorage();
  return film;
}

TEST_F(ExrIo, LossyCompressionChangesColoursALittleAndNothingElse) {
  EXPECT_FALSE(IsLossless(ExrCompression::kDwaa));
  const Film film = SmoothFilm();
  ASSERT_TRUE(WriteExr(Path("d.exr"), film, 128, 96, {}, ExrCompression::kDwaa).ok());
  const absl::StatusOr<ExrImage> image = ReadExr(Path("d.exr"));
  ASSERT_TRUE(image.ok()) << image.status();
  const absl::StatusOr<Film> back = FilmFromExr(*image);
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_NE(ImageHash(*back), ImageHash(film));
  EXPECT_EQ(LayerHash(*back, Layer::kDepth), LayerHash(film, Layer::kDepth));
  for (int c = 0; c < 4; ++c) {
    const auto was = film.Plane(Layer::kBeauty, c), is = back->Plane(Layer::kBeauty, c);
    for (size_t i = 0; i < was.size(); ++i) {
      ASSERT_NEAR(is[i], was[i], c == 3 ? 0 : 0.02f) << "channel " << c << ", value " << i;
    }
  }
}

TEST_F(ExrIo, NamesOfCompressions) {
  for (const char* name : {"none", "rle", "zips", "zip", "piz", "dwaa"}) {
    const auto compression = ExrCompressionFromName(name);
    ASSERT_TRUE(compression.ok()) << name;
    EXPECT_EQ(NameOf(*compression), name);
  }
  const auto unknown = ExrCompressionFromName("lzw");
  EXPECT_NE(unknown.status().message().find("none, rle, zips, zip, piz, dwaa"),
            absl::string_view::npos);
}

TEST_F(ExrIo, KeepsNumbersAndTheFrameRateExactly) {
  const Film film = TestFilm({0, 0, 4, 4}, {Layer::kBeauty});
  ExrMetadata metadata;
  metadata.ints["farpoint:frame"] = -7;
  for (const double rate : {24.0, 24000.0 / 1001, 23.976, 29.97, 12.5, 1000.0, 0.1}) {
    metadata.frames_per_second = rate;
    ASSERT_TRUE(WriteExr(Path("f.exr"), film, 4, 4, metadata, ExrCompression::kZip).ok());
    const absl::StatusOr<ExrImage> image = ReadExr(Path("f.exr"));
    ASSERT_TRUE(image.ok()) << image.status();
    EXPECT_EQ(image->metadata.ints.at("farpoint:frame"), -7);
    ASSERT_TRUE(image->metadata.frames_per_second.has_value());
    EXPECT_NEAR(*image->metadata.frames_per_second, rate, 1e-4 * rate);
  }
  metadata.frames_per_second = 23.976;
  ASSERT_TRUE(WriteExr(Path("f.exr"), film, 4, 4, metadata, ExrCompression::kZip).ok());
  EXPECT_EQ(*ReadExr(Path("f.exr"))->metadata.frames_per_second, 24000.0 / 1001);
  metadata.frames_per_second.reset();
  ASSERT_TRUE(WriteExr(Path("f.exr"), film, 4, 4, metadata, ExrCompression::kZip).ok());
  EXPECT_FALSE(ReadExr(Path("f.exr"))->metadata.frames_per_second.has_value());
}

TEST_F(ExrIo, ReadsBytesAsItReadsFiles) {
  const Film film = TestFilm({0, 0, 9, 7}, DefaultLayers());
  ASSERT_TRUE(WriteExr(Path("f.exr"), film, 9, 7, {}, ExrCompression::kZip).ok());
  const std::vector<std::byte> bytes = FileBytes("f.exr");
  const absl::StatusOr<ExrImage> image = ReadExr(bytes, "env/sky.exr");
  ASSERT_TRUE(image.ok()) << image.status();
  EXPECT_TRUE(SameFilm(*FilmFromExr(*image), film));
  const absl::Status cut = ReadExr(std::span(bytes).first(100), "env/sky.exr").status();
  EXPECT_NE(cut.message().find("'env/sky.exr'"), absl::string_view::npos) << cut;
}

TEST_F(ExrIo, HashesOfUnroundedFilmsAreThoseOfTheirStoredValues) {
  Film film({0, 0, 2, 1}, {Layer::kIndirect});
  const float a[3] = {0.1f, -0.0f, 1e9f};
  film.Set(Layer::kIndirect, 0, 0, a);
  ASSERT_TRUE(WriteExr(Path("f.exr"), film, 2, 1, {}, ExrCompression::kZip).ok());
  film.RoundToStorage();
  const absl::StatusOr<Film> back = FilmFromExr(*ReadExr(Path("f.exr")));
  ASSERT_TRUE(back.ok());
  EXPECT_EQ(ImageHash(*back), ImageHash(film));
}

TEST_F(ExrIo, KeepsMetadataAndSaysHowChannelsAreStored) {
  ExrMetadata metadata;
  metadata.strings["farpoint:version"] = "1.2.3";
  metadata.strings["empty"] = "";
  for (int i = 0; i < 16; ++i) metadata.matrices["worldToCamera"][i] = static_cast<float>(i) / 3;
  const Film film = TestFilm({0, 0, 4, 4}, {Layer::kBeauty, Layer::kIrradiance});
  ASSERT_TRUE(WriteExr(Path("f.exr"), film, 4, 4, metadata, ExrCompression::kZip).ok());
  const absl::StatusOr<ExrImage> image = ReadExr(Path("f.exr"));
  ASSERT_TRUE(image.ok()) << image.status();
  EXPECT_EQ(image->metadata.strings.at("farpoint:version"), "1.2.3");
  EXPECT_EQ(image->metadata.strings.at("empty"), "");
  EXPECT_EQ(image->metadata.matrices.at("worldToCamera"), metadata.matrices["worldToCamera"]);
  ASSERT_NE(image->Find("A"), nullptr);
  EXPECT_TRUE(image->Find("A")->half);
  ASSERT_NE(image->Find("irradiance.G"), nullptr);
  EXPECT_FALSE(image->Find("irradiance.G")->half);
  EXPECT_EQ(image->Find("irradiance"), nullptr);
}

TEST_F(ExrIo, TheSameFilmGivesTheSameFile) {
  const Film film = TestFilm({3, 4, 90, 80}, DefaultLayers());
  ASSERT_TRUE(WriteExr(Path("a.exr"), film, 100, 100, {}, ExrCompression::kZip).ok());
  ASSERT_TRUE(WriteExr(Path("b.exr"), film, 100, 100, {}, ExrCompression::kZip).ok());
  EXPECT_EQ(FileBytes("a.exr"), FileBytes("b.exr"));
}

TEST_F(ExrIo, RefusesWhatCannotBeWritten) {
  const Film film = TestFilm({0, 0, 8, 8}, {Layer::kBeauty});
  const auto write = [&](const Film& f, int w, int h, const ExrMetadata& m) {
    return WriteExr(Path("f.exr"), f, w, h, m, ExrCompression::kZip);
  };
  EXPECT_EQ(write(film, 7, 8, {}).code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(write(Film({0, 0, 8, 8}, {}), 8, 8, {}).code(), absl::StatusCode::kInvalidArgument);
  ExrMetadata clash;  // a name that the format uses for something else
  clash.strings["dataWindow"] = "x";
  EXPECT_EQ(write(film, 8, 8, clash).code(), absl::StatusCode::kInvalidArgument);
  EXPECT_FALSE(std::filesystem::exists(Path("f.exr")));
  EXPECT_EQ(WriteExr(Path("no/f.exr"), film, 8, 8, {}, ExrCompression::kZip).code(),
            absl::StatusCode::kNotFound);
}

TEST_F(ExrIo, MissingAndForeignFilesAreNamed) {
  const absl::Status missing = ReadExr(Path("none.exr")).status();
  EXPECT_EQ(missing.code(), absl::StatusCode::kNotFound);
  EXPECT_NE(missing.message().find("none.exr"), absl::string_view::npos);
  const std::string text = "this is no image";
  const absl::Status foreign =
      ReadBytes(std::as_bytes(std::span(text.data(), text.size()))).status();
  EXPECT_EQ(foreign.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_NE(foreign.message().find("bytes.exr"), absl::string_view::npos);
  EXPECT_FALSE(ReadBytes({}).ok());
}

TEST_F(ExrIo, EveryTruncationIsRefusedByName) {
  for (const ExrCompression compression :
       {ExrCompression::kNone, ExrCompression::kZip, ExrCompression::kPiz}) {
    const Film film = TestFilm({0, 0, 20, 40}, {Layer::kBeauty, Layer::kDepth});
    ASSERT_TRUE(WriteExr(Path("f.exr"), film, 20, 40, {}, compression).ok());
    const std::vector<std::byte> bytes = FileBytes("f.exr");
    for (size_t size = 0; size < bytes.size(); size += size < 600 ? 1 : 37) {
      const absl::Status status = ReadBytes(std::span(bytes).first(size)).status();
      ASSERT_FALSE(status.ok()) << size;
      ASSERT_NE(status.message().find("bytes.exr"), absl::string_view::npos) << status;
    }
    EXPECT_FALSE(ReadBytes(std::span(bytes).first(bytes.size() - 1)).ok());
    EXPECT_TRUE(ReadBytes(bytes).ok());
  }
}

TEST_F(ExrIo, RandomDamageIsRefusedOrReadButNeverFatal) {
  std::mt19937 random(11);
  int refused = 0;
  for (const ExrCompression compression :
       {ExrCompression::kNone, ExrCompression::kZip, ExrCompression::kPiz}) {
    const Film film = TestFilm({2, 3, 20, 40}, {Layer::kBeauty, Layer::kDepth});
    ASSERT_TRUE(WriteExr(Path("f.exr"), film, 20, 40, {}, compression).ok());
    const std::vector<std::byte> good = FileBytes("f.exr");
    for (int i = 0; i < 700; ++i) {
      std::vector<std::byte> bytes = good;
      const size_t range = random() % 2 ? bytes.size() : 400;  // the header more often
      for (int k = 0; k < 2; ++k) bytes[random() % range] = static_cast<std::byte>(random());
      const absl::StatusOr<ExrImage> image = ReadBytes(bytes);
      if (!image.ok()) {
        ++refused;
        ASSERT_NE(image.status().message().find("bytes.exr"), absl::string_view::npos);
        continue;
      }
      for (const ExrChannel& channel : image->channels) {
        ASSERT_EQ(channel.values.size(), static_cast<size_t>(image->data_window.area()));
      }
      FilmFromExr(*image).IgnoreError();
    }
  }
  EXPECT_GT(refused, 300);
}

// Rewrites the box of a window attribute in place.
void PatchBox(std::vector<std::byte>& bytes, std::string_view name, std::array<int32_t, 4> box) {
  const std::string key = std::string(name) + '\0' + "box2i" + '\0';
  const auto* begin = reinterpret_cast<const char*>(bytes.data());
  const size_t at = std::string_view(begin, bytes.size()).find(key);
  ASSERT_NE(at, std::string_view::npos);
  std::memcpy(bytes.data() + at + key.size() + 4, box.data(), sizeof(box));
}

TEST_F(ExrIo, HugeWindowsInASmallFileAreRefusedBeforeAllocation) {
  const Film film = TestFilm({0, 0, 8, 8}, {Layer::kBeauty});
  ASSERT_TRUE(WriteExr(Path("f.exr"), film, 8, 8, {}, ExrCompression::kZip).ok());
  for (const std::array<int32_t, 4> box :
       {std::array{0, 0, 65535, 16383}, std::array{0, 0, 2147483646, 2147483646},
        std::array{INT32_MIN, INT32_MIN, INT32_MAX, INT32_MAX}, std::array{0, 0, 65535, 15},
        std::array{5, 5, 4, 4}}) {
    std::vector<std::byte> bytes = FileBytes("f.exr");
    PatchBox(bytes, "dataWindow", box);
    EXPECT_FALSE(ReadBytes(bytes).ok());
    PatchBox(bytes, "displayWindow", box);
    EXPECT_FALSE(ReadBytes(bytes).ok());
  }
}

TEST_F(ExrIo, TheDisplayWindowIsTheOrigin) {
  const Film film = TestFilm({2, 3, 6, 7}, {Layer::kDepth});
  ASSERT_TRUE(WriteExr(Path("f.exr"), film, 8, 8, {}, ExrCompression::kNone).ok());
  std::vector<std::byte> bytes = FileBytes("f.exr");
  PatchBox(bytes, "displayWindow", {-10, 1, 9, 8});
  const absl::StatusOr<ExrImage> image = ReadBytes(bytes);
  ASSERT_TRUE(image.ok()) << image.status();
  EXPECT_EQ(image->data_window, (PixelRect{12, 2, 16, 6}));
  EXPECT_EQ(image->frame_width, 20);
  EXPECT_EQ(image->frame_height, 8);
}

TEST_F(ExrIo, MultiPartAndDeepFilesAreRefusedWithAReason) {
  const Film film = TestFilm({0, 0, 8, 8}, {Layer::kBeauty});
  ASSERT_TRUE(WriteExr(Path("f.exr"), film, 8, 8, {}, ExrCompression::kZip).ok());
  for (const std::byte flags : {std::byte{0x10}, std::byte{0x08}}) {
    std::vector<std::byte> bytes = FileBytes("f.exr");
    bytes[5] = bytes[5] | flags;
    const absl::Status status = ReadBytes(bytes).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
    EXPECT_NE(status.message().find("several parts"), absl::string_view::npos) << status;
  }
}

TEST(FilmFromExr, TakesCompleteLayersOnly) {
  ExrImage image;
  image.data_window = {0, 0, 1, 1};
  image.frame_width = image.frame_height = 1;
  for (const char* name : {"direct.R", "direct.G", "Z", "something"}) {
    image.channels.push_back({name, std::string_view(name) != "Z", {0.5f}});
  }
  const absl::StatusOr<Film> film = FilmFromExr(image);
  ASSERT_TRUE(film.ok()) << film.status();
  ASSERT_EQ(film->layers().size(), 1u);
  EXPECT_EQ(film->Get(Layer::kDepth, 0, 0, 0), 0.5f);
}

TEST(FilmFromExr, RefusesForeignImages) {
  ExrImage image;
  image.data_window = {0, 0, 1, 1};
  image.channels.push_back({"Y", true, {1.0f}});
  EXPECT_FALSE(FilmFromExr(image).ok());
  image.channels = {{"Z", true, {1.0f}}};  // a depth in half is not ours
  EXPECT_FALSE(FilmFromExr(image).ok());
  image.channels = {{"Z", false, {1.0f, 2.0f}}};  // two values for one pixel
  EXPECT_FALSE(FilmFromExr(image).ok());
}

}  // namespace
}  // namespace farpoint
