// Submit, status, cancel, fetch and compare against a real coordinator and real workers.
#include "tests/integration/farm.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>

#include <filesystem>
#include <nlohmann/json.hpp>

#include "core/image/exr_io.h"

namespace farpoint {
namespace {

using std::chrono::seconds;
using testing::AllOf;
using testing::HasSubstr;
using testing::Not;
using testing::StartsWith;
using Json = nlohmann::json;

std::vector<std::string> operator+(std::vector<std::string> a, const std::vector<std::string>& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

std::vector<std::string> SmallScene() {
  return {SceneFile("cornell.gltf"),
          "--resolution",
          "64x64",
          "--points",
          "1500",
          "--light-samples",
          "1",
          "--tile",
          "32",
          "--clusters",
          "4",
          "--microbuffer",
          "8"};
}
// Minutes of work in tiles that start and finish often.
std::vector<std::string> LongJob() {
  return {SceneFile("cornell.gltf"),
          "--resolution",
          "1024x1024",
          "--integrator",
          "pt",
          "--paths",
          "4096",
          "--tile",
          "32",
          "--points",
          "10"};
}

class FarmTest : public testing::Test {
 protected:
  void SetUp() override { farm_.StartServer(); }

  RunResult Run(const std::vector<std::string>& args) {
    return farm_.Client(farm_.WithCoordinator(args));
  }
  // The id of a job that nobody waits for.
  std::string Detach(const std::vector<std::string>& scene) {
    const RunResult result =
        Run(std::vector<std::string>{"submit"} + scene + std::vector<std::string>{"--detach"});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    EXPECT_THAT(result.out, testing::MatchesRegex("[0-9a-f]+\n"));
    return result.out.substr(0, result.out.find('\n'));
  }
  std::string StateOf(const std::string& job) {
    const std::string text = farm_.Status(job);
    return text.empty() ? "" : Json::parse(text)["state"].get<std::string>();
  }

  Farm farm_;
};

TEST_F(FarmTest, SubmitsWatchesFetchesAndStitches) {
  farm_.StartWorker();
  const RunResult result =
      Run(std::vector<std::string>{"submit"} + SmallScene() +
          std::vector<std::string>{"-o", farm_.File("farm.exr"), "--png", farm_.File("farm.png"),
                                   "--json", farm_.File("farm.json"), "--title", "a title"});
  ASSERT_EQ(result.exit_code, 0) << result.err << farm_.Logs();
  EXPECT_THAT(result.err, AllOf(HasSubstr("done, 4 of 4 tiles"), HasSubstr("image hash ")));
  EXPECT_EQ(result.out, "");

  const RunResult embedded =
      farm_.Client(std::vector<std::string>{"render"} + SmallScene() +
                   std::vector<std::string>{"-o", farm_.File("embedded.exr"), "--json",
                                            farm_.File("embedded.json")});
  ASSERT_EQ(embedded.exit_code, 0) << embedded.err;
  EXPECT_EQ(ImageHashOf(farm_.File("farm.exr")), ImageHashOf(farm_.File("embedded.exr")));
  EXPECT_THAT(farm_.Read("farm.png"), StartsWith("\x89PNG"));

  const Json a = Json::parse(farm_.Read("farm.json"));
  const Json b = Json::parse(farm_.Read("embedded.json"));
  EXPECT_EQ(a["hash"], b["hash"]);
  EXPECT_EQ(a["hash"]["image"], ImageHashOf(farm_.File("farm.exr")));
  EXPECT_EQ(a["counts"], b["counts"]);
  EXPECT_GT(a["counts"]["receivers"], 3000);  // all pixels but those beside the box
  EXPECT_LE(a["counts"]["receivers"], 64 * 64);
  EXPECT_GT(a["counts"]["surfels"], 500);
  EXPECT_GT(a["counts"]["triangles"], 10);
  EXPECT_GT(a["seconds"]["total"], 0);
  EXPECT_GT(a["seconds"]["wall"], 0);
  EXPECT_GT(a["bytes"]["scene"], 0);
  EXPECT_GT(a["bytes"]["tree"], 0);
  EXPECT_GT(a["bytes"]["peak_rss"], 1 << 20);

  const auto image = ReadExr(farm_.File("farm.exr"));
  ASSERT_TRUE(image.ok());
  EXPECT_EQ(image->metadata.strings.at("farpoint:version"), FARPOINT_VERSION);
  EXPECT_EQ(image->metadata.strings.count("farpoint:jobHash"), 1u);
  EXPECT_EQ(Json::parse(image->metadata.strings.at("farpoint:settings"))["film"]["width_px"], 64);
  EXPECT_EQ(image->metadata.matrices.count("worldToCamera"), 1u);
  EXPECT_EQ(image->metadata.matrices.count("worldToNDC"), 1u);
}

TEST_F(FarmTest, NothingIsLeftBesideTheImage) {
  farm_.StartWorker();
  std::filesystem::create_directory(farm_.File("images"));
  ASSERT_EQ(Run(std::vector<std::string>{"submit"} + SmallScene() +
                std::vector<std::string>{"-o", farm_.File("images/a.exr")})
                .exit_code,
            0);
  for (const auto& entry : std::filesystem::directory_iterator(farm_.File("images"))) {
    EXPECT_EQ(entry.path().filename(), "a.exr");
  }
}

TEST_F(FarmTest, ADetachedJobIsFetchedLater) {
  const std::string job = Detach(SmallScene());
  const RunResult early = Run({"fetch", job, "-o", farm_.File("early.exr")});
  EXPECT_EQ(early.exit_code, 75);
  EXPECT_THAT(early.err, AllOf(HasSubstr(job), HasSubstr("not done")));
  EXPECT_FALSE(std::filesystem::exists(farm_.File("early.exr")));

  farm_.StartWorker();
  EXPECT_TRUE(WaitUntil(seconds(60), [&] { return StateOf(job) == "done"; })) << farm_.Logs();
  const Json status = Json::parse(farm_.Status(job));
  EXPECT_EQ(status["id"], job);
  EXPECT_EQ(status["tiles"],
            Json({{"queued", 0}, {"leased", 0}, {"committed", 4}, {"failed", 0}, {"total", 4}}));
  EXPECT_TRUE(status.contains("eta_s"));
  EXPECT_EQ(status["reissued"], 0);
  EXPECT_EQ(status["refused_results"], 0);

  ASSERT_EQ(Run({"fetch", job, "-o", farm_.File("a.exr")}).exit_code, 0);
  ASSERT_EQ(Run({"fetch", job, "-o", farm_.File("b.exr")}).exit_code, 0) << "more than once";
  EXPECT_EQ(ImageHashOf(farm_.File("a.exr")), ImageHashOf(farm_.File("b.exr")));
}

TEST_F(FarmTest, StatusListsJobsAndWorkers) {
  EXPECT_EQ(Json::parse(farm_.Status()),
            Json({{"jobs", Json::array()}, {"workers", Json::array()}}));
  farm_.StartWorker(2);
  const std::string job = Detach(SmallScene() + std::vector<std::string>{"--title", "the title"});
  EXPECT_TRUE(WaitUntil(seconds(30), [&] {
    const std::string text = farm_.Status();
    return !text.empty() && Json::parse(text)["workers"].size() == 1;
  })) << farm_.Logs();
  const Json status = Json::parse(farm_.Status());
  ASSERT_EQ(status["jobs"].size(), 1u);
  EXPECT_EQ(status["jobs"][0]["id"], job);
  EXPECT_EQ(status["jobs"][0]["title"], "the title");
  EXPECT_EQ(status["workers"][0]["threads"], 2);
  EXPECT_EQ(status["workers"][0]["version"], FARPOINT_VERSION);
  const RunResult table = Run({"status"});
  EXPECT_THAT(table.out, AllOf(HasSubstr(job), HasSubstr("the title")));
}

TEST_F(FarmTest, FilesThatTheCoordinatorHasAreNotSentAgain) {
  const auto submit = [&] {
    return Run(std::vector<std::string>{"submit"} + SmallScene() +
               std::vector<std::string>{"--detach", "--log-level", "debug"})
        .err;
  };
  EXPECT_THAT(submit(), HasSubstr("sent "));
  EXPECT_THAT(submit(), Not(HasSubstr("sent ")));
}

TEST_F(FarmTest, ACancelledJobEndsForAllWhoWait) {
  farm_.StartWorker();
  const auto waiting = farm_.StartClient(
      farm_.WithCoordinator(std::vector<std::string>{"submit"} + LongJob() +
                            std::vector<std::string>{"-o", farm_.File("never.exr")}),
      "waiting");
  std::string job;
  ASSERT_TRUE(WaitUntil(seconds(60), [&] {
    const std::string text = farm_.Status();
    if (text.empty()) return false;
    const Json jobs = Json::parse(text)["jobs"];
    if (jobs.size() != 1 || jobs[0]["tiles"]["leased"] == 0) return false;
    job = jobs[0]["id"];
    return true;
  })) << farm_.Logs();
  EXPECT_EQ(Run({"cancel", job}).exit_code, 0);
  EXPECT_EQ(waiting->Wait(seconds(30)), 42);
  EXPECT_THAT(farm_.Read("waiting.err"), HasSubstr("cancelled"));
  EXPECT_FALSE(std::filesystem::exists(farm_.File("never.exr")));
  EXPECT_EQ(StateOf(job), "cancelled");
  EXPECT_EQ(Run({"cancel", job}).exit_code, 0) << "cancelling again is harmless";
  // The worker is free for another job.
  EXPECT_EQ(Run(std::vector<std::string>{"submit"} + SmallScene() +
                std::vector<std::string>{"-o", farm_.File("next.exr")})
                .exit_code,
            0);
}

// What people have said about their jobs survives as their tiles do.
TEST_F(FarmTest, PausesChainsRequeuesAndFramesSurviveAKill) {
  const auto frames = SmallScene() + std::vector<std::string>{"--frames", "1-3"};
  const std::string paused = Detach(frames + std::vector<std::string>{"--paused"});
  const std::string first = Detach(LongJob());
  const std::string chained = Detach(SmallScene() + std::vector<std::string>{"--after", first});
  const std::string taken_up = Detach(frames);
  const auto status = [&](const std::string& job) { return Json::parse(farm_.Status(job)); };
  EXPECT_TRUE(WaitUntil(seconds(30), [&] { return StateOf(taken_up) == "rendering"; }));
  EXPECT_EQ(Run({"cancel", taken_up}).exit_code, 0);
  EXPECT_EQ(Run({"requeue", taken_up}).exit_code, 0);
  EXPECT_EQ(Run({"priority", taken_up, "7"}).exit_code, 0);
  const Json frames_before = status(taken_up)["frames"];
  farm_.server().Signal(SIGKILL);
  farm_.server().Wait(seconds(10));
  farm_.StartServer();

  EXPECT_EQ(StateOf(paused), "paused");
  EXPECT_EQ(StateOf(chained), "queued");
  EXPECT_EQ(StateOf(taken_up), "rendering");
  EXPECT_EQ(status(taken_up)["priority"], 7);
  EXPECT_GE(status(taken_up)["frames"]["baked"], frames_before["baked"]);
  EXPECT_EQ(status(taken_up)["tiles"]["total"], 12);
  EXPECT_THAT(Run({"explain", paused}).out, HasSubstr("farpoint resume " + paused));
  EXPECT_THAT(Run({"explain", chained}).out, HasSubstr("waits for job " + first));

  farm_.StartWorker();
  EXPECT_TRUE(WaitUntil(seconds(60), [&] { return StateOf(taken_up) == "done"; })) << farm_.Logs();
  EXPECT_EQ(Run({"resume", paused}).exit_code, 0);
  EXPECT_EQ(Run({"priority", paused, "5"}).exit_code, 0);
  EXPECT_TRUE(WaitUntil(seconds(60), [&] { return StateOf(paused) == "done"; })) << farm_.Logs();
  EXPECT_EQ(StateOf(chained), "queued");
  // What it waits for will not be done.
  EXPECT_EQ(Run({"cancel", first}).exit_code, 0);
  EXPECT_EQ(StateOf(chained), "failed");
  EXPECT_THAT(status(chained)["error"].get<std::string>(), HasSubstr(first));

  ASSERT_EQ(Run({"fetch", taken_up, "-o", farm_.File("taken.####.exr")}).exit_code, 0);
  ASSERT_EQ(Run({"fetch", paused, "-o", farm_.File("paused.####.exr")}).exit_code, 0);
  for (const char* frame : {"0001", "0003"}) {
    const std::string name = std::string(".") + frame + ".exr";
    EXPECT_EQ(ImageHashOf(farm_.File("taken" + name)), ImageHashOf(farm_.File("paused" + name)));
  }
}

TEST(Services, ABadAddressIsWrongUsage) {
  Farm farm;
  for (const char* address : {"nowhere", "host:99999", ":7447"}) {
    for (const std::vector<std::string>& args :
         {std::vector<std::string>{"farpoint-server", "--listen", address, "--store",
                                   farm.File("store")},
          {"farpoint-worker", "--coordinator", address, "--cache", farm.File("cache")}}) {
      std::vector<std::string> command = args;
      command[0] = BinFolder() + "/" + command[0];
      const std::string name = args[0] + address;
      Process process(command, farm.File(name), farm.File(name));
      EXPECT_EQ(process.Wait(seconds(20)), 2) << name;
      EXPECT_THAT(farm.Read(name), AllOf(StartsWith(args[0] + ": " + args[1]), HasSubstr(address),
                                         HasSubstr("HOST:PORT")));
    }
  }
}

TEST_F(FarmTest, AnUnknownJobIsAPermanentError) {
  for (const std::vector<std::string>& args : {std::vector<std::string>{"status", "deadbeef"},
                                               {"cancel", "deadbeef"},
                                               {"fetch", "deadbeef", "-o", farm_.File("x.exr")}}) {
    const RunResult result = Run(args);
    EXPECT_EQ(result.exit_code, 42) << args[0];
    EXPECT_THAT(result.err, AllOf(StartsWith("farpoint: error: "), HasSubstr("deadbeef")));
  }
}

TEST_F(FarmTest, ASignalEndsTheClientButNotTheJob) {
  const auto client = farm_.StartClient(
      farm_.WithCoordinator(std::vector<std::string>{"submit"} + SmallScene() +
                            std::vector<std::string>{"-o", farm_.File("late.exr")}),
      "client");
  std::string job;
  ASSERT_TRUE(WaitUntil(seconds(30), [&] {
    const std::string text = farm_.Status();
    if (text.empty() || Json::parse(text)["jobs"].empty()) return false;
    job = Json::parse(text)["jobs"][0]["id"];
    return farm_.Read("client.err").find("job " + job) != std::string::npos;
  }));
  client->Signal(SIGTERM);
  EXPECT_EQ(client->Wait(seconds(10)), 143);
  EXPECT_THAT(farm_.Read("client.err"), HasSubstr("farpoint fetch " + job));
  farm_.StartWorker();
  EXPECT_TRUE(WaitUntil(seconds(60), [&] { return StateOf(job) == "done"; })) << farm_.Logs();
}

TEST(Client, SaysTryAgainWhereNoCoordinatorAnswers) {
  Farm farm;
  for (const std::vector<std::string>& args :
       {std::vector<std::string>{"status"},
        {"cancel", "ab"},
        {"fetch", "ab", "-o", "x.exr"},
        {"submit", SceneFile("cornell.gltf"), "-o", "x.exr"}}) {
    // Port 9 is the discard service, which nobody runs.
    const RunResult result =
        farm.Client(args + std::vector<std::string>{"--coordinator", "127.0.0.1:9", "--patience",
                                                    "0.3", "--log-level", "error"});
    EXPECT_EQ(result.exit_code, 75) << args[0];
    EXPECT_THAT(result.err, AllOf(StartsWith("farpoint: error: coordinator 127.0.0.1:9 "),
                                  HasSubstr("check that it runs")));
  }
}

TEST(Client, StopsAnEmbeddedRenderAtOnce) {
  for (const int signal : {SIGINT, SIGTERM}) {
    Farm farm;
    const auto client = farm.StartClient(std::vector<std::string>{"render"} + LongJob() +
                                             std::vector<std::string>{"-o", farm.File("a.exr")},
                                         "client");
    ASSERT_TRUE(WaitUntil(seconds(30), [&] {
      return farm.Read("client.err").find("rendering") != std::string::npos;
    })) << farm.Read("client.err");
    client->Signal(signal);
    EXPECT_EQ(client->Wait(seconds(20)), 128 + signal);
    EXPECT_FALSE(std::filesystem::exists(farm.File("a.exr")));
    EXPECT_FALSE(std::filesystem::exists(farm.File("a.exr.part")));
  }
}

TEST(Client, ComparesImages) {
  Farm farm;
  for (const char* integrator : {"pbgi", "fpbgi"}) {
    ASSERT_EQ(
        farm.Client(std::vector<std::string>{"render"} + SmallScene() +
                    std::vector<std::string>{"-o", farm.File(std::string(integrator) + ".exr"),
                                             "--integrator", integrator, "--aov", "irradiance"})
            .exit_code,
        0);
  }
  const RunResult same =
      farm.Client({"compare", farm.File("pbgi.exr"), farm.File("pbgi.exr"), "--json", "-"});
  ASSERT_EQ(same.exit_code, 0) << same.err;
  const Json equal = Json::parse(same.out);
  EXPECT_EQ(equal["hash_equal"], true);
  EXPECT_EQ(equal["mse"], 0);
  EXPECT_EQ(equal["max_abs"], 0);
  EXPECT_EQ(equal["pdp"], 0);
  const RunResult other =
      farm.Client({"compare", farm.File("fpbgi.exr"), farm.File("pbgi.exr"), "--layer",
                   "irradiance", "--json", farm.File("c.json"), "--diff", farm.File("d.png")});
  ASSERT_EQ(other.exit_code, 0) << other.err;
  const Json different = Json::parse(farm.Read("c.json"));
  EXPECT_EQ(different["hash_equal"], false);
  EXPECT_GT(different["rel_rmse"], 0);
  EXPECT_LT(different["rel_rmse"], 0.5);
  EXPECT_THAT(other.out, HasSubstr("rel_rmse"));
  EXPECT_THAT(farm.Read("d.png"), StartsWith("\x89PNG"));
  const RunResult unknown =
      farm.Client({"compare", farm.File("fpbgi.exr"), farm.File("pbgi.exr"), "--layer", "nothing"});
  EXPECT_EQ(unknown.exit_code, 42);
  EXPECT_THAT(unknown.err, AllOf(HasSubstr(farm.File("fpbgi.exr")), HasSubstr("irradiance")));
  const std::vector<std::string> noisy = {"compare",
                                          farm.File("fpbgi.exr"),
                                          farm.File("pbgi.exr"),
                                          "--layer",
                                          "irradiance",
                                          "--noise",
                                          "5",
                                          "--json",
                                          "-"};
  const RunResult warned = farm.Client(noisy);
  EXPECT_EQ(Json::parse(warned.out)["noise_above_error"], true);
  EXPECT_THAT(warned.err, HasSubstr("warning: --noise 5"));
  std::vector<std::string> quiet = noisy;
  quiet.emplace_back("--quiet");
  EXPECT_EQ(farm.Client(quiet).err, "");
}

}  // namespace
}  // namespace farpoint
