// Jobs as people run them: sequences, several at once, told to rest, to wait for each other and to
// go on, left alone and fetched later. Real processes; pixels are compared with those of an
// embedded render.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>

#include <algorithm>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <set>
#include <sstream>

#include "core/image/exr_io.h"
#include "tests/integration/farm.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using testing::AllOf;
using testing::HasSubstr;
using testing::StartsWith;
using Args = std::vector<std::string>;
using Json = nlohmann::json;

Args operator+(Args a, const Args& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

// Two boxes that move, four tiles a frame, a few milliseconds each.
Args Moving() {
  return {SceneFile("cornell_moves.gltf"),
          "--resolution",
          "64x64",
          "--tile",
          "32",
          "--points",
          "500",
          "--light-samples",
          "1",
          "--clusters",
          "4",
          "--microbuffer",
          "8"};
}
// One frame of 16 tiles that take long enough to be interrupted.
Args Slow() {
  return {SceneFile("cornell.gltf"),
          "--resolution",
          "128x128",
          "--tile",
          "32",
          "--integrator",
          "pt",
          "--paths",
          "256",
          "--light-samples",
          "1",
          "--points",
          "10"};
}

class Jobs : public testing::Test {
 protected:
  void SetUp() override { farm_.StartServer(); }

  RunResult Run(const Args& args) { return farm_.Client(farm_.WithCoordinator(args)); }
  std::string File(const std::string& name) { return farm_.File(name); }
  std::string Detach(const Args& job) {
    const RunResult result = Run(Args{"submit", "--detach"} + job);
    EXPECT_EQ(result.exit_code, 0) << result.err;
    EXPECT_THAT(result.out, testing::MatchesRegex("[0-9a-f]+\n"));
    return result.out.substr(0, result.out.find('\n'));
  }
  Json Status(const std::string& job) {
    const std::string text = farm_.Status(job);
    return text.empty() ? Json::object() : Json::parse(text);
  }
  std::string StateOf(const std::string& job) { return Status(job).value("state", ""); }
  bool WaitForState(const std::string& job, const std::string& state) {
    return WaitUntil(seconds(60), [&] { return StateOf(job) == state; });
  }
  std::string Explain(const std::string& job) {
    const RunResult result = Run({"explain", job});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return result.out;
  }
  // The job's history, an object per line.
  std::vector<Json> Log(const std::string& job) {
    const RunResult result = Run({"logs", job, "--json", "-"});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    std::vector<Json> lines;
    std::istringstream stream(result.out);
    for (std::string line; std::getline(stream, line);) lines.push_back(Json::parse(line));
    return lines;
  }
  // The times at which a job's tiles were committed, in order. They compare as text.
  std::vector<std::string> CommitTimes(const std::string& job) {
    std::vector<std::string> times;
    for (const Json& line : Log(job)) {
      if (line["text"] == "committed") times.push_back(line["time"]);
    }
    return times;
  }

  Farm farm_;
};

ExrMetadata HeaderOf(const std::string& path) {
  const auto image = ReadExr(path);
  EXPECT_TRUE(image.ok()) << image.status();
  return image.ok() ? image->metadata : ExrMetadata();
}

TEST_F(Jobs, ASequenceHasTheSameFramesEmbeddedAndOnAFarm) {
  farm_.StartWorker();
  const Args frames = {"--frames", "0-24x12,6", "--fps", "48", "--title", "boxes"};
  const RunResult farm = Run(Args{"submit"} + Moving() + frames +
                             Args{"-o", File("farm.###.exr"), "--json", File("farm.json")});
  ASSERT_EQ(farm.exit_code, 0) << farm.err << farm_.Logs();
  EXPECT_THAT(farm.err, HasSubstr("done, 16 of 16 tiles, 4 of 4 frames"));
  const RunResult embedded =
      farm_.Client(Args{"render"} + Moving() +
                   Args{"--frames", "6,0,24,12", "--fps", "48", "-o", File("own.%03d.exr"), "--png",
                        File("own.#.png"), "--json", File("own.json")});
  ASSERT_EQ(embedded.exit_code, 0) << embedded.err;

  std::set<std::string> hashes;
  for (const char* number : {"000", "006", "012", "024"}) {
    const std::string a = File("farm." + std::string(number) + ".exr");
    EXPECT_EQ(ImageHashOf(a), ImageHashOf(File("own." + std::string(number) + ".exr"))) << number;
    hashes.insert(ImageHashOf(a));
    const ExrMetadata header = HeaderOf(a);
    EXPECT_EQ(header.ints.at("farpoint:frame"), std::stoi(number));
    EXPECT_EQ(header.frames_per_second, 48);
    EXPECT_EQ(header.strings.at("comments"), "boxes");
    EXPECT_EQ(header.strings.at("farpoint:jobHash"),
              HeaderOf(File("own." + std::string(number) + ".exr")).strings.at("farpoint:jobHash"))
        << "a frame does not know which others were asked for";
  }
  EXPECT_EQ(hashes.size(), 4u) << "something moves";
  EXPECT_THAT(farm_.Read("own.24.png"), StartsWith("\x89PNG"));

  const Json statistics = Json::parse(farm_.Read("own.json"));
  ASSERT_EQ(statistics["frames"].size(), 4u);
  EXPECT_EQ(statistics["hash"], Json::parse(farm_.Read("farm.json"))["hash"]);
  EXPECT_EQ(statistics["counts"]["receivers"],
            Json::parse(farm_.Read("farm.json"))["counts"]["receivers"]);
  for (const Json& frame : statistics["frames"]) {
    EXPECT_EQ(frame["hash"]["image"], ImageHashOf(frame["file"].get<std::string>()));
  }
}

TEST_F(Jobs, ACropOfAFrameHasTheFramesPixels) {
  for (const Args& crop : {Args{}, Args{"--crop", "17,9,50,41"}}) {
    const std::string name = crop.empty() ? "whole.##.exr" : "crop.##.exr";
    const RunResult result =
        farm_.Client(Args{"render"} + Moving() +
                     Args{"--frames", "12", "--spp", "2", "--filter", "triangle", "--aov",
                          "irradiance", "-o", File(name)} +
                     crop);
    ASSERT_EQ(result.exit_code, 0) << result.err;
  }
  EXPECT_EQ(CropHashOf(File("whole.12.exr"), {17, 9, 50, 41}), ImageHashOf(File("crop.12.exr")));
  const auto image = ReadExr(File("crop.12.exr"));
  ASSERT_TRUE(image.ok());
  EXPECT_EQ(image->data_window, (PixelRect{17, 9, 50, 41}));
  EXPECT_EQ(image->frame_width, 64);
  EXPECT_NE(image->Find("irradiance.R"), nullptr);
}

TEST_F(Jobs, FramesNeedNamesOfTheirOwn) {
  for (const char* verb : {"render", "submit"}) {
    Args args = Args{verb} + Moving() + Args{"--frames", "1-3", "-o", File("one.exr")};
    if (std::string(verb) == "submit") args = farm_.WithCoordinator(args);
    const RunResult result = farm_.Client(args);
    EXPECT_EQ(result.exit_code, 2);
    EXPECT_THAT(result.err, AllOf(StartsWith("farpoint: error: -o "), HasSubstr("one.####.exr")));
  }
  EXPECT_EQ(Json::parse(farm_.Status())["jobs"].size(), 0u) << "nothing was submitted";
  farm_.StartWorker();
  EXPECT_EQ(Run(Args{"submit"} + Moving() + Args{"--frames", "3", "-o", File("one.exr")}).exit_code,
            0)
      << "a single frame needs none";
  EXPECT_TRUE(std::filesystem::exists(File("one.exr")));
}

TEST_F(Jobs, ADetachedJobIsFetchedLater) {
  const RunResult left = Run(Args{"submit", "--detach"} + Moving() +
                             Args{"--frames", "0,24", "-o", File("later.##.exr")});
  ASSERT_EQ(left.exit_code, 0) << left.err;
  const std::string job = left.out.substr(0, left.out.find('\n'));
  EXPECT_THAT(left.err, HasSubstr("farpoint fetch " + job + " -o " + File("later.##.exr")));
  EXPECT_FALSE(std::filesystem::exists(File("later.00.exr")));

  const RunResult early = Run({"fetch", job, "-o", File("later.##.exr")});
  EXPECT_EQ(early.exit_code, 75) << early.err;
  EXPECT_THAT(early.err, HasSubstr("0 of 2 frames are written"));
  EXPECT_EQ(Run({"fetch", job, "-o", File("later.##.exr"), "--frames", "0-2"}).exit_code, 2);

  const auto waiting = farm_.StartClient(
      farm_.WithCoordinator({"fetch", job, "--wait", "-o", File("later.##.exr")}), "waiting");
  farm_.StartWorker();
  EXPECT_EQ(waiting->Wait(seconds(60)), 0) << farm_.Read("waiting.err") << farm_.Logs();
  ASSERT_EQ(
      Run({"fetch", job, "-o", File("again.##.exr"), "--frames", "24", "--compression", "piz"})
          .exit_code,
      0);
  EXPECT_FALSE(std::filesystem::exists(File("again.00.exr")));
  EXPECT_EQ(ImageHashOf(File("again.24.exr")), ImageHashOf(File("later.24.exr")))
      << "the compression changes no pixel";
  EXPECT_NE(ImageHashOf(File("later.00.exr")), ImageHashOf(File("later.24.exr")));

  ASSERT_EQ(Run({"fetch", job, "-o", File("lossy.##.exr"), "--compression", "dwaa"}).exit_code, 0);
  const ExrMetadata lossy = HeaderOf(File("lossy.24.exr"));
  EXPECT_FALSE(lossy.strings.contains("farpoint:imageHash"));
  EXPECT_EQ(lossy.strings.at("farpoint:renderedHash"), ImageHashOf(File("later.24.exr")));
}

TEST_F(Jobs, APausedJobRestsAndGoesOnWithTheSamePixels) {
  ASSERT_EQ(farm_.Client(Args{"render"} + Slow() + Args{"-o", File("reference.exr")}).exit_code, 0);
  farm_.StartWorker();
  const std::string job = Detach(Slow());
  ASSERT_TRUE(WaitUntil(seconds(60), [&] {
    const Json status = Status(job);
    return status.contains("tiles") && status["tiles"]["committed"] >= 2;
  })) << farm_.Logs();
  const RunResult paused = Run({"pause", job});
  EXPECT_EQ(paused.exit_code, 0) << paused.err;
  EXPECT_THAT(paused.err, HasSubstr("job " + job + " is paused"));
  // The tile in work is finished, no other one starts.
  ASSERT_TRUE(WaitUntil(seconds(30), [&] { return Status(job)["tiles"]["leased"] == 0; }));
  const int committed = Status(job)["tiles"]["committed"];
  ASSERT_LT(committed, 16) << "the job must be longer for this test to say something";
  std::this_thread::sleep_for(milliseconds(500));
  EXPECT_EQ(Status(job)["tiles"]["committed"], committed);
  EXPECT_THAT(Explain(job), HasSubstr("paused"));

  EXPECT_EQ(Run({"fetch", job, "-o", File("early.exr")}).exit_code, 75);
  EXPECT_FALSE(std::filesystem::exists(File("early.exr")));
  const RunResult partial = Run({"fetch", job, "-o", File("partial.exr"), "--partial"});
  EXPECT_EQ(partial.exit_code, 0) << partial.err;
  EXPECT_EQ(HeaderOf(File("partial.exr")).ints.at("farpoint:missingTiles"), 16 - committed);
  EXPECT_EQ(CropHashOf(File("partial.exr"), {0, 0, 32, 32}),
            CropHashOf(File("reference.exr"), {0, 0, 32, 32}));

  EXPECT_EQ(Run({"resume", job}).exit_code, 0);
  const RunResult watched = Run({"watch", job, "--json", "-"});
  EXPECT_EQ(watched.exit_code, 0) << watched.err;
  EXPECT_EQ(Json::parse(watched.out)["state"], "done");
  ASSERT_EQ(Run({"fetch", job, "-o", File("farm.exr")}).exit_code, 0);
  EXPECT_EQ(ImageHashOf(File("farm.exr")), ImageHashOf(File("reference.exr")));
}

TEST_F(Jobs, AJobStartsWhenThoseBeforeItAreDone) {
  farm_.StartWorker();
  const std::string first = Detach(Moving() + Args{"--paused"});
  const std::string second = Detach(Moving() + Args{"--after", first, "--title", "second"});
  EXPECT_EQ(Status(second)["after"], Json({first}));
  EXPECT_EQ(StateOf(first), "paused");
  EXPECT_THAT(Explain(second), HasSubstr(first));
  std::this_thread::sleep_for(milliseconds(300));
  EXPECT_EQ(StateOf(second), "queued");

  // Without the one before it, it cannot be.
  EXPECT_EQ(Run({"cancel", first}).exit_code, 0);
  const RunResult failed = Run({"watch", first, second});
  EXPECT_EQ(failed.exit_code, 42);
  EXPECT_THAT(failed.err, AllOf(HasSubstr(first), HasSubstr(second)));
  EXPECT_EQ(StateOf(second), "failed");

  // Both go on where they were.
  EXPECT_EQ(Run({"requeue", first}).exit_code, 0);
  ASSERT_EQ(Run({"watch", first}).exit_code, 0) << farm_.Logs();
  EXPECT_EQ(Run({"requeue", second}).exit_code, 0);
  ASSERT_EQ(Run({"watch", second}).exit_code, 0) << farm_.Logs();
  EXPECT_GT(CommitTimes(second).front(), CommitTimes(first).back());

  const RunResult unknown =
      Run(Args{"submit", "--detach"} + Moving() + Args{"--after", "deadbeef"});
  EXPECT_EQ(unknown.exit_code, 42);
  EXPECT_THAT(unknown.err, HasSubstr("deadbeef"));
}

TEST_F(Jobs, ARequeueOfAllRendersADoneJobAgain) {
  farm_.StartWorker();
  const std::string job = Detach(Moving());
  ASSERT_EQ(Run({"watch", job}).exit_code, 0);
  ASSERT_EQ(Run({"fetch", job, "-o", File("a.exr")}).exit_code, 0);
  EXPECT_EQ(Run({"requeue", job}).exit_code, 0);
  EXPECT_EQ(StateOf(job), "done") << "nothing is left to do";
  EXPECT_EQ(Run({"requeue", job, "--all"}).exit_code, 0);
  ASSERT_EQ(Run({"watch", job}).exit_code, 0);
  ASSERT_EQ(Run({"fetch", job, "-o", File("b.exr")}).exit_code, 0);
  EXPECT_EQ(ImageHashOf(File("a.exr")), ImageHashOf(File("b.exr")));
  EXPECT_EQ(CommitTimes(job).size(), 8u) << "each tile twice";
}

TEST_F(Jobs, ThePriorityDecidesWhoIsServedFirst) {
  const std::string older = Detach(Moving());
  const std::string newer = Detach(Moving() + Args{"--seed", "1"});
  const std::string urgent = Detach(Moving() + Args{"--seed", "2", "--priority", "5"});
  const RunResult lowered = Run({"priority", older, "-5"});
  EXPECT_EQ(lowered.exit_code, 0) << lowered.err;
  EXPECT_EQ(Status(older)["priority"], -5);
  // Baked without a worker, so that only the order of tiles is left to decide.
  for (const std::string& job : {older, newer, urgent}) {
    ASSERT_TRUE(WaitForState(job, "rendering")) << job << farm_.Logs();
  }
  EXPECT_THAT(Explain(older), HasSubstr("no worker"));
  farm_.StartWorker();
  const RunResult watched = Run({"watch", "--json", "-"});
  ASSERT_EQ(watched.exit_code, 0) << watched.err;
  EXPECT_EQ(Json::parse(watched.out).size(), 3u) << "all that had not ended";
  EXPECT_GE(CommitTimes(newer).front(), CommitTimes(urgent).back());
  EXPECT_GE(CommitTimes(older).front(), CommitTimes(newer).back());
  const RunResult nothing = Run({"watch"});
  EXPECT_EQ(nothing.exit_code, 0);
  EXPECT_THAT(nothing.err, HasSubstr("every job has ended"));
}

TEST_F(Jobs, TheLogTellsWhatHappened) {
  const std::string job = Detach(Moving());
  const auto following =
      farm_.StartClient(farm_.WithCoordinator({"logs", job, "--follow"}), "following");
  ASSERT_EQ(Run({"pause", job}).exit_code, 0);
  ASSERT_EQ(Run({"resume", job}).exit_code, 0);
  farm_.StartWorker();
  EXPECT_EQ(following->Wait(seconds(60)), 0) << "it ends with the job";
  const std::string text = farm_.Read("following.out");
  EXPECT_THAT(text, AllOf(HasSubstr("the job is paused"), HasSubstr("the job is rendering"),
                          HasSubstr("tile 3: committed"), HasSubstr("the job is done")));
  const std::vector<Json> lines = Log(job);
  EXPECT_EQ(static_cast<size_t>(std::count(text.begin(), text.end(), '\n')), lines.size());
  ASSERT_FALSE(lines.empty());
  for (size_t i = 0; i < lines.size(); ++i) EXPECT_EQ(lines[i]["sequence"], i + 1);
  EXPECT_EQ(lines.back()["state"], "done");
}

TEST_F(Jobs, WorkersAreListed) {
  farm_.StartWorker();
  std::string text;
  ASSERT_TRUE(WaitUntil(seconds(20), [&] {
    text = Run({"workers", "--json", "-"}).out;
    return !text.empty() && Json::parse(text)["workers"].size() == 1;
  }));
  EXPECT_EQ(Json::parse(text)["workers"][0]["threads"], 1);
  EXPECT_THAT(Run({"workers"}).out,
              AllOf(StartsWith("WORKER"),
                    HasSubstr(Json::parse(text)["workers"][0]["id"].get<std::string>())));
}

TEST_F(Jobs, AWatchEndsWithASignalAndTheJobGoesOn) {
  const std::string job = Detach(Moving());
  const auto watching = farm_.StartClient(farm_.WithCoordinator({"watch", job}), "watching");
  ASSERT_TRUE(WaitUntil(seconds(20), [&] { return !farm_.Read("watching.err").empty(); }));
  watching->Signal(SIGINT);
  EXPECT_EQ(watching->Wait(seconds(10)), 130);
  EXPECT_EQ(Run({"watch", "deadbeef"}).exit_code, 42);
  EXPECT_EQ(Run({"watch", job, "deadbeef"}).exit_code, 42);
  farm_.StartWorker();
  EXPECT_EQ(Run({"watch", job}).exit_code, 0);
}

TEST_F(Jobs, AnInterruptedSequenceIsFetchedToItsEnd) {
  const Args job = Moving() + Args{"--frames", "0-20x4"};
  ASSERT_EQ(farm_.Client(Args{"render"} + job + Args{"-o", File("own.##.exr")}).exit_code, 0);
  const auto client = farm_.StartClient(
      farm_.WithCoordinator(Args{"submit"} + job + Args{"-o", File("farm.##.exr")}), "client");
  farm_.StartWorker();
  ASSERT_TRUE(WaitUntil(seconds(60), [&] { return std::filesystem::exists(File("farm.00.exr")); }));
  client->Signal(SIGINT);
  const auto code = client->Wait(seconds(20));
  ASSERT_TRUE(code == 130 || code == 0) << "0: it was done before the signal came";
  const std::string id = Json::parse(farm_.Status())["jobs"][0]["id"];
  if (code == 130) {
    EXPECT_THAT(farm_.Read("client.err"), HasSubstr("farpoint fetch " + id));
  }
  ASSERT_EQ(Run({"watch", id}).exit_code, 0);
  ASSERT_EQ(Run({"fetch", id, "-o", File("farm.##.exr")}).exit_code, 0);
  for (const char* number : {"00", "04", "08", "12", "16", "20"}) {
    const std::string name = std::string(".") + number + ".exr";
    EXPECT_EQ(ImageHashOf(File("farm" + name)), ImageHashOf(File("own" + name))) << number;
    EXPECT_FALSE(std::filesystem::exists(File("farm" + name + ".part")));
  }
}

TEST_F(Jobs, TheSampleJobFileSaysAllThatItCan) {
  farm_.StartWorker();
  const Args small = {"--resolution", "64x64",           "--spp", "1",        "--points",
                      "500",          "--light-samples", "1",     "--frames", "0,24"};
  const Args job = Args{SceneFile("cornell_dusk.json")} + small;
  const RunResult farm = Run(Args{"submit"} + job + Args{"-o", File("dusk.##.exr")});
  ASSERT_EQ(farm.exit_code, 0) << farm.err << farm_.Logs();
  ASSERT_EQ(farm_.Client(Args{"render"} + job + Args{"-o", File("own.##.exr")}).exit_code, 0);
  EXPECT_EQ(ImageHashOf(File("dusk.24.exr")), ImageHashOf(File("own.24.exr")));
  EXPECT_NE(ImageHashOf(File("dusk.24.exr")), ImageHashOf(File("dusk.00.exr")));
  const ExrMetadata header = HeaderOf(File("dusk.24.exr"));
  const Json settings = Json::parse(header.strings.at("farpoint:settings"));
  EXPECT_EQ(settings["settings"]["filter"], "PIXEL_FILTER_GAUSSIAN");
  EXPECT_EQ(settings["settings"]["spp"], 1) << "the flag overrides the file";
  EXPECT_EQ(settings["overrides"]["environment"]["uri"], "env/dusk.exr");
  EXPECT_EQ(settings["overrides"]["lights"][0]["kind"], "LIGHT_KIND_SPOT");
  EXPECT_EQ(settings["overrides"]["materials"][0]["name"], "red");
  EXPECT_EQ(header.strings.at("comments"), "the boxes move at dusk");

  // The override was not only carried: the wall that was red is blue now.
  const Film film = FilmOf(File("dusk.00.exr"));
  EXPECT_GT(film.Get(Layer::kBeauty, 2, 4, 32), film.Get(Layer::kBeauty, 0, 4, 32));
}

}  // namespace
}  // namespace farpoint
