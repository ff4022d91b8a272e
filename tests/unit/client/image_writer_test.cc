#include "client/image_writer.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>
#include <nlohmann/json.hpp>

#include "tests/unit/client/sample_job.h"
#include "tests/unit/client/temp_folder.h"

namespace farpoint {
namespace {

using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::StartsWith;
using Json = nlohmann::json;

const FilmSpec kFilm{64, 48, {8, 4, 40, 48}};

class ImageWriterTest : public testing::Test {
 protected:
  absl::StatusOr<ImageWriter> Make(OutputOptions options) {
    return ImageWriter::Create(std::move(options), std::chrono::steady_clock::now(), console_);
  }
  // The status of CheckNames for these names.
  absl::Status Check(const std::string& exr, const std::string& png, size_t frames, bool sequence) {
    const auto writer = Make({.exr = exr, .png = png});
    EXPECT_TRUE(writer.ok()) << writer.status();
    return writer->CheckNames(frames, sequence);
  }
  FetchedFrame Frame(uint32_t index, uint32_t missing = 0) {
    return {index, SampleFilm(kFilm.crop, {Layer::kBeauty, Layer::kDepth}, index), missing};
  }
  Film FilmOf(const std::string& path) {
    const auto image = ReadExr(path);
    EXPECT_TRUE(image.ok()) << image.status();
    const auto film = image.ok() ? FilmFromExr(*image) : absl::StatusOr<Film>(image.status());
    return film.ok() ? *film : Film();
  }
  Json Statistics() {
    std::ifstream file(folder_.File("s.json"));
    return Json::parse(file);
  }

  TempFolder folder_;
  Console console_{stderr, false, ConsoleLevel::kOff, true};
};

TEST_F(ImageWriterTest, NamesMustTellFramesApart) {
  EXPECT_TRUE(Check("a.exr", "", 1, false).ok());
  EXPECT_TRUE(Check("a.#.exr", "a.png", 1, false).ok()) << "nothing special in a still's name";
  EXPECT_TRUE(Check("a.exr", "a.png", 1, true).ok());
  EXPECT_TRUE(Check("a.#.exr", "a.%d.png", 9, true).ok());
  EXPECT_THAT(std::string(Check("b/a.exr", "", 9, true).message()),
              AllOf(StartsWith("-o b/a.exr: "), HasSubstr("9 frames"), HasSubstr("b/a.####.exr")));
  EXPECT_THAT(std::string(Check("a.#.exr", "a.png", 9, true).message()),
              AllOf(StartsWith("--png a.png: "), HasSubstr("a.####.png")));
  EXPECT_THAT(std::string(Make({.exr = "#.#.exr"}).status().message()), StartsWith("-o #.#.exr: "));
  EXPECT_THAT(std::string(Make({.exr = "a.exr", .png = "#.#.png"}).status().message()),
              StartsWith("--png #.#.png: "));
}

TEST_F(ImageWriterTest, WritesAStillUnderTheNameAsItStands) {
  auto writer = Make({.exr = folder_.File("a#b.exr"), .json = folder_.File("s.json")});
  ASSERT_TRUE(writer.ok());
  ASSERT_TRUE(writer->Write(MakeSampleJob(kFilm).info, Frame(0)).ok());
  ASSERT_TRUE(writer->WriteStatistics().ok());
  EXPECT_EQ(ImageHash(FilmOf(folder_.File("a#b.exr"))), ImageHash(Frame(0).film));
  EXPECT_EQ(Statistics()["hash"]["image"], ImageHash(Frame(0).film).Hex());
  EXPECT_FALSE(Statistics().contains("frames"));
  EXPECT_GT(Statistics()["bytes"]["peak_rss"], 0);
}

TEST_F(ImageWriterTest, WritesEachFrameUnderItsNumber) {
  auto writer = Make({.exr = folder_.File("a.###.exr"),
                      .png = folder_.File("a.%d.png"),
                      .json = folder_.File("s.json")});
  ASSERT_TRUE(writer.ok());
  const JobInfo info = MakeSampleJob(kFilm, {7, 12}).info;
  ASSERT_TRUE(writer->Write(info, Frame(1)).ok());
  EXPECT_TRUE(std::filesystem::exists(folder_.File("a.012.exr")));
  EXPECT_FALSE(std::filesystem::exists(folder_.File("a.007.exr")));
  ASSERT_TRUE(writer->Write(info, Frame(0, 2)).ok());
  EXPECT_TRUE(std::filesystem::exists(folder_.File("a.7.png")));
  EXPECT_EQ(ImageHash(FilmOf(folder_.File("a.007.exr"))), ImageHash(Frame(0).film));
  EXPECT_EQ(ImageHash(FilmOf(folder_.File("a.012.exr"))), ImageHash(Frame(1).film));
  ASSERT_TRUE(writer->WriteStatistics().ok());
  const Json frames = Statistics()["frames"];
  ASSERT_EQ(frames.size(), 2u);
  EXPECT_EQ(frames[0]["frame"], 12);
  EXPECT_EQ(frames[1]["file"], folder_.File("a.007.exr"));
  EXPECT_EQ(frames[1]["missing_tiles"], 2);
  std::vector<int32_t> numbers;
  for (const FrameReport& frame : writer->written()) numbers.push_back(frame.number);
  EXPECT_THAT(numbers, ElementsAre(12, 7));
}

TEST_F(ImageWriterTest, SaysWhereItCouldNotWriteAndForgetsThatFrame) {
  auto writer = Make({.exr = folder_.File("none/a.exr")});
  ASSERT_TRUE(writer.ok());
  const absl::Status status = writer->Write(MakeSampleJob(kFilm).info, Frame(0));
  EXPECT_FALSE(status.ok());
  EXPECT_THAT(std::string(status.message()), HasSubstr("none/a.exr"));
  EXPECT_TRUE(writer->written().empty());
}

}  // namespace
}  // namespace farpoint
