#include "client/display_server.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <chrono>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>

#include "tests/unit/client/sample_job.h"
#include "tests/unit/client/tev_listener.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::SizeIs;

// An odd crop: six tiles of five sizes.
const FilmSpec kFilm{120, 90, {5, 7, 100, 70}};
const std::vector<Layer> kLayers = {Layer::kBeauty, Layer::kDepth};

template <typename Condition>
bool Eventually(Condition&& condition) {
  const auto end = std::chrono::steady_clock::now() + seconds(60);
  while (!condition()) {
    if (std::chrono::steady_clock::now() > end) return false;
    std::this_thread::sleep_for(milliseconds(5));
  }
  return true;
}

class DisplayServerTest : public testing::Test {
 protected:
  DisplayOptions Options(const std::string& address) {
    DisplayOptions options;
    options.address = address;
    options.name = [](const JobInfo& info, uint32_t frame) {
      return "frame " + std::to_string(info.frames[frame].number);
    };
    options.warn = [this](const std::string& text) {
      std::lock_guard lock(mutex_);
      warnings_.push_back(text);
    };
    options.finish_time = seconds(60);
    options.stall_time = seconds(60);
    return options;
  }
  std::vector<std::string> Warnings() {
    std::lock_guard lock(mutex_);
    return warnings_;
  }
  Film FrameFilm(uint32_t frame = 0) { return SampleFilm(kFilm.crop, kLayers, frame); }
  void ShowTiles(DisplayServer& display, uint32_t first, uint32_t count) {
    for (uint32_t i = first; i < first + count; ++i) {
      display.ShowTile(job_.info, i,
                       SampleFilm(job_.info.tiles[i].rect, kLayers, job_.info.tiles[i].frame));
    }
  }
  // The image is the film, pixel by pixel.
  void ExpectEqual(const TevImage& image, const Film& film) {
    EXPECT_THAT(image.channels, ElementsAre("R", "G", "B", "A", "Z"));
    ASSERT_EQ(image.width, film.rect().width());
    ASSERT_EQ(image.height, film.rect().height());
    EXPECT_TRUE(image.Complete());
    std::vector<float> expected;
    for (const Layer layer : film.layers()) {
      for (size_t c = 0; c < InfoOf(layer).channels.size(); ++c) {
        const auto plane = film.Plane(layer, static_cast<int>(c));
        expected.insert(expected.end(), plane.begin(), plane.end());
      }
    }
    EXPECT_EQ(image.values, expected);
  }

  SampleJob job_ = MakeSampleJob(kFilm);
  std::mutex mutex_;
  std::vector<std::string> warnings_;
};

TEST_F(DisplayServerTest, TheViewerGetsEveryPixelOnce) {
  TevListener viewer;
  DisplayServer display(Options(viewer.address()));
  ShowTiles(display, 0, static_cast<uint32_t>(job_.tiles.size()));
  ShowTiles(display, 0, static_cast<uint32_t>(job_.tiles.size()));
  display.ShowFrame(job_.info, 0, FrameFilm());
  display.Finish();
  ASSERT_TRUE(Eventually([&] { return viewer.images()["frame 0"].Complete(); }));
  EXPECT_EQ(viewer.fault(), "");
  const TevImage image = viewer.images()["frame 0"];
  ExpectEqual(image, FrameFilm());
  EXPECT_EQ(*std::max_element(image.writes.begin(), image.writes.end()), 1);
  EXPECT_EQ(viewer.packets(), static_cast<int>(job_.tiles.size()) + 1);
  EXPECT_THAT(Warnings(), IsEmpty());
}

TEST_F(DisplayServerTest, ATileShowsBeforeItsFrameIsWhole) {
  TevListener viewer;
  DisplayServer display(Options(viewer.address()));
  ShowTiles(display, 1, 1);
  ASSERT_TRUE(Eventually([&] { return viewer.packets() == 2; }));
  const TevImage image = viewer.images()["frame 0"];
  const PixelRect& rect = job_.info.tiles[1].rect;
  for (int y = 0; y < image.height; ++y) {
    for (int x = 0; x < image.width; ++x) {
      EXPECT_EQ(image.writes[static_cast<size_t>(y * image.width + x)],
                rect.Contains(x + kFilm.crop.x0, y + kFilm.crop.y0) ? 1 : 0);
    }
  }
}

TEST_F(DisplayServerTest, WhatTheQueueHadNoRoomForComesWithTheFrame) {
  TevListener viewer;
  DisplayOptions options = Options(viewer.address());
  options.queue_bytes = 0;
  DisplayServer display(std::move(options));
  ShowTiles(display, 0, static_cast<uint32_t>(job_.tiles.size()));
  EXPECT_EQ(viewer.packets(), 0);
  display.ShowFrame(job_.info, 0, FrameFilm());
  display.Finish();
  ASSERT_TRUE(Eventually([&] { return viewer.images()["frame 0"].Complete(); }));
  ExpectEqual(viewer.images()["frame 0"], FrameFilm());
  EXPECT_EQ(viewer.fault(), "");
}

TEST_F(DisplayServerTest, AViewerThatComesLaterGetsAll) {
  int port = 0;
  { port = TevListener().port(); }
  DisplayServer display(Options("127.0.0.1:" + std::to_string(port)));
  ShowTiles(display, 0, 2);
  ASSERT_TRUE(Eventually([&] { return !Warnings().empty(); }));
  display.Finish();  // at once: nobody is there
  TevListener viewer({.port = port});
  ShowTiles(display, 2, static_cast<uint32_t>(job_.tiles.size()) - 2);
  ASSERT_TRUE(Eventually([&] { return viewer.images()["frame 0"].Complete(); }));
  ExpectEqual(viewer.images()["frame 0"], FrameFilm());
  EXPECT_EQ(viewer.fault(), "");
  EXPECT_THAT(Warnings(), ElementsAre(AllOf(HasSubstr("--display-server 127.0.0.1:"),
                                            HasSubstr("connection refused"))));
}

TEST_F(DisplayServerTest, AViewerThatHungUpGetsTheFrameAgain) {
  TevListener viewer({.hang_up_after = 3});
  DisplayServer display(Options(viewer.address()));
  ShowTiles(display, 0, 2);
  ASSERT_TRUE(Eventually([&] { return viewer.packets() == 3; }));
  display.ShowFrame(job_.info, 0, FrameFilm());
  ASSERT_TRUE(Eventually([&] {
    const TevImage image = viewer.images()["frame 0"];
    return viewer.connections() == 2 && image.Complete() &&
           image.values[0] == FrameFilm().Get(Layer::kBeauty, 0, kFilm.crop.x0, kFilm.crop.y0);
  }));
  display.Finish();
  EXPECT_EQ(viewer.fault(), "");
  ExpectEqual(viewer.images()["frame 0"], FrameFilm());
  EXPECT_LE(Warnings().size(), 1u);
}

TEST_F(DisplayServerTest, AViewerThatTakesNothingIsGivenUpAndNobodyWaits) {
  TevListener viewer({.read = false, .receive_buffer_bytes = 4096});
  // More than the buffers of both sides take.
  const FilmSpec large{4096, 1024, {0, 0, 4096, 1024}};
  SampleJob job;
  job.info.spec.film = large;
  job.info.frames.resize(1);
  job.info.tiles = {{large.crop, {}, 0}};
  DisplayOptions options = Options(viewer.address());
  options.stall_time = milliseconds(200);
  DisplayServer display(std::move(options));
  const Film film(large.crop, {Layer::kBeauty});
  display.ShowFrame(job.info, 0, film);
  ASSERT_TRUE(Eventually([&] { return !Warnings().empty(); }));
  EXPECT_THAT(Warnings(), ElementsAre(HasSubstr("the viewer has taken nothing")));
  const auto start = std::chrono::steady_clock::now();
  for (int i = 0; i < 1000; ++i) display.ShowTile(job.info, 0, film);
  display.Finish();
  EXPECT_LT(std::chrono::steady_clock::now() - start, seconds(30)) << "neither waits nor copies";
  EXPECT_THAT(Warnings(), SizeIs(1));
}

TEST_F(DisplayServerTest, FinishGivesASlowViewerItsTimeOnly) {
  TevListener viewer({.read = false, .receive_buffer_bytes = 4096});
  const FilmSpec large{4096, 1024, {0, 0, 4096, 1024}};
  SampleJob job;
  job.info.spec.film = large;
  job.info.frames.resize(1);
  job.info.tiles = {{large.crop, {}, 0}};
  DisplayOptions options = Options(viewer.address());
  options.finish_time = milliseconds(100);
  auto display = std::make_unique<DisplayServer>(std::move(options));
  display->ShowFrame(job.info, 0, Film(large.crop, {Layer::kBeauty}));
  display->Finish();
  EXPECT_THAT(Warnings(), ElementsAre(HasSubstr("in time")));
  display.reset();  // while the thread is sending
}

TEST_F(DisplayServerTest, ASequenceKeepsItsLastFramesOpen) {
  job_ = MakeSampleJob(kFilm, {10, 20, 30, 40});
  TevListener viewer;
  DisplayOptions options = Options(viewer.address());
  options.open_images = 2;
  DisplayServer display(std::move(options));
  const auto per_frame = static_cast<uint32_t>(job_.tiles.size() / 4);
  for (uint32_t frame = 0; frame < 4; ++frame) {
    ShowTiles(display, frame * per_frame, per_frame - 1);
    display.ShowFrame(job_.info, frame, FrameFilm(frame));
    display.Finish();
  }
  ASSERT_TRUE(Eventually([&] { return viewer.images()["frame 40"].Complete(); }));
  EXPECT_EQ(viewer.fault(), "");
  EXPECT_THAT(viewer.closed(), ElementsAre("frame 10", "frame 20"));
  const auto images = viewer.images();
  ExpectEqual(images.at("frame 30"), FrameFilm(2));
  ExpectEqual(images.at("frame 40"), FrameFilm(3));
}

TEST_F(DisplayServerTest, ATileOutsideItsFrameIsNotShown) {
  TevListener viewer;
  DisplayServer display(Options(viewer.address()));
  job_.info.tiles[0].rect = {0, 0, 32, 32};  // left of the crop
  display.ShowTile(job_.info, 0, SampleFilm({0, 0, 32, 32}, kLayers));
  display.ShowTile(job_.info, 1, SampleFilm({0, 0, 8, 8}, kLayers));   // another tile's pixels
  display.ShowTile(job_.info, 99, SampleFilm({0, 0, 8, 8}, kLayers));  // no tile of the job
  ShowTiles(display, 2, 1);
  display.Finish();
  ASSERT_TRUE(Eventually([&] { return viewer.packets() >= 2; }));
  EXPECT_EQ(viewer.packets(), 2);
  EXPECT_EQ(viewer.fault(), "");
}

TEST_F(DisplayServerTest, AnUnknownAddressIsTold) {
  DisplayServer display(Options("127.0.0.1:no-such-service"));
  ShowTiles(display, 0, 1);
  ASSERT_TRUE(Eventually([&] { return !Warnings().empty(); }));
  EXPECT_THAT(Warnings(), ElementsAre(HasSubstr("'no-such-service' is not a port")));
}

}  // namespace
}  // namespace farpoint
