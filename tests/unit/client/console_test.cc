#include "client/console.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdio>
#include <memory>
#include <string>

namespace farpoint {
namespace {

struct CloseFile {
  void operator()(std::FILE* file) const { std::fclose(file); }
};

// A stream whose text can be read back.
class Capture {
 public:
  Capture() : file_(std::tmpfile()) {}
  std::FILE* file() { return file_.get(); }
  std::string Text() {
    std::fflush(file());
    std::string text(static_cast<size_t>(std::ftell(file())), '\0');
    std::rewind(file());
    EXPECT_EQ(std::fread(text.data(), 1, text.size(), file()), text.size());
    return text;
  }

 private:
  std::unique_ptr<std::FILE, CloseFile> file_;
};

JobStatus Rendering(uint32_t committed, uint32_t total) {
  JobStatus status;
  status.state = JobState::kRendering;
  status.tiles = {.queued = total - committed, .committed = committed, .total = total};
  status.progress = static_cast<double>(committed) / total;
  return status;
}

TEST(Console, PutsItsNameInFrontOfEachLine) {
  Capture capture;
  Console console(capture.file(), false, ConsoleLevel::kInfo, false);
  console.Error("film is empty");
  console.Warn("slow");
  console.Info("job 1");
  EXPECT_EQ(capture.Text(),
            "farpoint: error: film is empty\nfarpoint: warning: slow\n"
            "farpoint: job 1\n");
}

TEST(Console, ShowsOnlyWhatItsLevelLetsThrough) {
  Capture capture;
  Console console(capture.file(), false, ConsoleLevel::kError, false);
  console.Debug("a");
  console.Info("b");
  console.Warn("c");
  console.Progress(Rendering(1, 2));
  console.Error("d");
  EXPECT_EQ(capture.Text(), "farpoint: error: d\n");
}

TEST(Console, IsQuietButForWarningsAndErrors) {
  Capture capture;
  Console console(capture.file(), true, ConsoleLevel::kDebug, true);
  console.Info("a");
  console.Progress(Rendering(1, 2));
  console.Warn("b");
  EXPECT_EQ(capture.Text(), "farpoint: warning: b\n");
}

TEST(Console, WritesALinePerTenthWhereThereIsNoTerminal) {
  Capture capture;
  Console console(capture.file(), false, ConsoleLevel::kInfo, false);
  for (uint32_t i = 0; i <= 100; ++i) console.Progress(Rendering(i, 100));
  const std::string text = capture.Text();
  EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 11) << text;
  EXPECT_EQ(text.find('\x1b'), std::string::npos);
  EXPECT_NE(text.find("farpoint: rendering, 50 of 100 tiles, 50 %\n"), std::string::npos);
}

TEST(Console, ALineSaysHowLongItWillTake) {
  Capture capture;
  Console console(capture.file(), false, ConsoleLevel::kInfo, false);
  JobStatus status = Rendering(5, 10);
  status.eta_s = 65;
  console.Progress(status);
  EXPECT_EQ(capture.Text(), "farpoint: rendering, 5 of 10 tiles, 50 %, eta 1:05\n");
}

TEST(Console, ReportsOfSeveralJobsNameThem) {
  Capture capture;
  Console console(capture.file(), true, ConsoleLevel::kInfo, false);
  for (uint32_t i = 0; i <= 100; ++i) {
    for (const char* id : {"a1", "b2"}) {
      JobStatus status = Rendering(i, 100);
      status.id = JobId{id};
      status.frames = {.total = 5, .baked = 5, .done = i / 20};
      console.Report(status);
    }
  }
  const std::string text = capture.Text();
  EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 22) << "a line per tenth and job" << text;
  EXPECT_NE(text.find("farpoint: job b2 rendering, 50 of 100 tiles, 2 of 5 frames, 50 %\n"),
            std::string::npos)
      << text;
}

TEST(Console, RedrawsOneLineOnATerminal) {
  Capture capture;
  Console console(capture.file(), true, ConsoleLevel::kInfo, false);
  for (uint32_t i = 0; i <= 10; ++i) console.Progress(Rendering(i, 10));
  const std::string text = capture.Text();
  EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 0);
  EXPECT_EQ(std::count(text.begin(), text.end(), '\r'), 11);
}

TEST(Console, ClearsTheBarBeforeAMessage) {
  Capture capture;
  Console console(capture.file(), true, ConsoleLevel::kInfo, false);
  console.Progress(Rendering(1, 10));
  console.Info("note");
  const std::string text = capture.Text();
  EXPECT_TRUE(text.ends_with("\r\x1b[Kfarpoint: note\n")) << text;
}

TEST(ProgressText, ShowsBarShareTilesAndTimeLeft) {
  JobStatus status = Rendering(1, 4);
  status.eta_s = 65;
  status.reissued = 2;
  const std::string text = ProgressText(status, 79);
  EXPECT_NE(text.find(" 25 %  1/4 tiles  2 again  eta 1:05"), std::string::npos) << text;
  EXPECT_LE(text.size(), 79u);
  const auto bar = text.substr(0, text.find(']'));
  const auto full = std::count(bar.begin(), bar.end(), '#');
  const auto empty = std::count(bar.begin(), bar.end(), '-');
  EXPECT_NEAR(static_cast<double>(full) / (full + empty), 0.25, 0.03);
}

TEST(ProgressText, NamesTheStateBeforeThereAreTiles) {
  JobStatus status;
  status.state = JobState::kBaking;
  EXPECT_EQ(ProgressText(status, 79), "baking");
  EXPECT_EQ(ProgressText(status, 79, 72.4), "baking, 1:12");
}

TEST(ProgressText, SaysHowManyFramesAreDoneAndThatAJobRests) {
  JobStatus status = Rendering(4, 8);
  status.frames = {.total = 2, .baked = 2, .done = 1};
  EXPECT_NE(ProgressText(status, 79).find("4/8 tiles  1/2 frames"), std::string::npos);
  status.state = JobState::kPaused;
  EXPECT_NE(ProgressText(status, 79).find("frames  paused"), std::string::npos);
  status.tiles.committed = 0;
  EXPECT_EQ(ProgressText(status, 79), "paused");
}

TEST(ProgressText, StaysInsideNarrowTerminalsAndOddNumbers) {
  JobStatus status = Rendering(1, 3);
  status.progress = 7;
  for (int columns = 20; columns < 100; ++columns) {
    const std::string text = ProgressText(status, columns);
    EXPECT_LE(static_cast<int>(text.size()), std::max(columns, 24)) << text;
  }
}

TEST(DurationText, GroupsSeconds) {
  EXPECT_EQ(DurationText(0), "0:00");
  EXPECT_EQ(DurationText(65.4), "1:05");
  EXPECT_EQ(DurationText(7384), "2:03:04");
  EXPECT_EQ(DurationText(-3), "0:00");
}

TEST(ConsoleLevelFromName, KnowsItsNamesOnly) {
  EXPECT_EQ(*ConsoleLevelFromName("debug"), ConsoleLevel::kDebug);
  EXPECT_EQ(*ConsoleLevelFromName("off"), ConsoleLevel::kOff);
  EXPECT_FALSE(ConsoleLevelFromName("loud").ok());
}

}  // namespace
}  // namespace farpoint
