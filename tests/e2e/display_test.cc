// farpoint --display-server, by the programs as people run them: what a viewer gets is, bit by bit,
// what the image file holds.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstring>
#include <thread>

#include "core/image/exr_io.h"
#include "tests/integration/farm.h"
#include "tests/unit/client/tev_listener.h"

namespace farpoint {
namespace {

using std::chrono::seconds;
using testing::HasSubstr;
using testing::Not;
using Args = std::vector<std::string>;

Args operator+(Args a, const Args& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

// A crop that begins within a block; twelve tiles.
Args Scene() {
  return {SceneFile("cornell.gltf"),
          "--resolution",
          "160x120",
          "--crop",
          "10,5,128,90",
          "--tile",
          "32",
          "--integrator",
          "pt",
          "--paths",
          "16",
          "--light-samples",
          "1"};
}

bool SameBits(const std::vector<float>& values, size_t first, const std::vector<float>& channel) {
  return values.size() >= first + channel.size() &&
         std::memcmp(values.data() + first, channel.data(), channel.size() * sizeof(float)) == 0;
}

void ExpectEqual(const TevImage& image, const std::string& exr) {
  const auto file = ReadExr(exr);
  ASSERT_TRUE(file.ok()) << file.status();
  ASSERT_EQ(image.width, file->data_window.width());
  ASSERT_EQ(image.height, file->data_window.height());
  ASSERT_EQ(image.channels.size(), file->channels.size());
  for (size_t c = 0; c < image.channels.size(); ++c) {
    const ExrChannel* channel = file->Find(image.channels[c]);
    ASSERT_NE(channel, nullptr) << image.channels[c];
    EXPECT_TRUE(SameBits(image.values, c * image.writes.size(), channel->values))
        << image.channels[c];
  }
  for (const int writes : image.writes) ASSERT_EQ(writes, 1);
}

class Display : public testing::Test {
 protected:
  Args Show(const TevListener& viewer) { return {"--display-server", viewer.address()}; }
  std::string File(const std::string& name) { return farm_.File(name); }
  Farm farm_;
};

TEST_F(Display, AnEmbeddedRenderShowsWhatItWrites) {
  TevListener viewer;
  const RunResult run =
      farm_.Client(Args{"render"} + Scene() + Args{"-o", File("a.exr")} + Show(viewer));
  ASSERT_EQ(run.exit_code, 0) << run.err;
  EXPECT_THAT(run.err, Not(HasSubstr("warning")));
  ASSERT_TRUE(WaitUntil(seconds(60), [&] { return viewer.images()["a.exr"].Complete(); }));
  EXPECT_EQ(viewer.fault(), "");
  ExpectEqual(viewer.images()["a.exr"], File("a.exr"));
}

TEST_F(Display, AFarmsTilesAreShownByWhoeverWaits) {
  farm_.StartServer();
  TevListener submitter, watcher, fetcher;
  const RunResult paused =
      farm_.Client(farm_.WithCoordinator(Args{"submit", "--detach", "--title", "box"} + Scene()));
  ASSERT_EQ(paused.exit_code, 0) << paused.err;
  const std::string job = paused.out.substr(0, paused.out.find('\n'));
  const auto watch =
      farm_.StartClient(farm_.WithCoordinator(Args{"watch", job} + Show(watcher)), "watch");
  const auto fetch = farm_.StartClient(
      farm_.WithCoordinator(Args{"fetch", job, "--wait", "-o", File("f.exr")} + Show(fetcher)),
      "fetch");
  farm_.StartWorker();
  const RunResult run = farm_.Client(farm_.WithCoordinator(
      Args{"submit"} + Scene() + Args{"-o", File("s.exr")} + Show(submitter)));
  ASSERT_EQ(run.exit_code, 0) << run.err;
  EXPECT_EQ(watch->Wait(seconds(60)), 0);
  EXPECT_EQ(fetch->Wait(seconds(60)), 0);
  ASSERT_TRUE(WaitUntil(seconds(60), [&] {
    return submitter.images()["s.exr"].Complete() && watcher.images()["box"].Complete() &&
           fetcher.images()["f.exr"].Complete();
  }));
  ExpectEqual(submitter.images()["s.exr"], File("s.exr"));
  ExpectEqual(fetcher.images()["f.exr"], File("f.exr"));
  ExpectEqual(watcher.images()["box"], File("f.exr"));
  EXPECT_EQ(submitter.fault() + watcher.fault() + fetcher.fault(), "");
  EXPECT_EQ(ImageHashOf(File("s.exr")), ImageHashOf(File("f.exr")));
}

TEST_F(Display, AViewerThatIsNotThereOrTakesNothingFailsNoRender) {
  const Args render = Args{"render"} + Scene();
  ASSERT_EQ(farm_.Client(render + Args{"-o", File("plain.exr")}).exit_code, 0);
  int port = 0;
  { port = TevListener().port(); }
  const RunResult nobody = farm_.Client(render + Args{"-o", File("nobody.exr"), "--display-server",
                                                      "127.0.0.1:" + std::to_string(port)});
  EXPECT_EQ(nobody.exit_code, 0);
  EXPECT_THAT(nobody.err, HasSubstr("warning: --display-server 127.0.0.1:"));
  EXPECT_EQ(nobody.err.find("warning"), nobody.err.rfind("warning")) << "one warning";
  TevListener deaf({.read = false, .receive_buffer_bytes = 4096});
  const RunResult stalled = farm_.Client(render + Args{"-o", File("deaf.exr")} + Show(deaf));
  EXPECT_EQ(stalled.exit_code, 0) << stalled.err;
  const std::string hash = ImageHashOf(File("plain.exr"));
  EXPECT_EQ(ImageHashOf(File("nobody.exr")), hash);
  EXPECT_EQ(ImageHashOf(File("deaf.exr")), hash);
}

}  // namespace
}  // namespace farpoint
