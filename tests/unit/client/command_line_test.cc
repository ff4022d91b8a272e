#include "client/command_line.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/unit/client/temp_folder.h"

namespace farpoint {
namespace {

using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Pair;
using testing::StartsWith;

CommandLine Parse(const std::vector<std::string>& args, const std::string& environment = "") {
  auto line = ParseCommandLine(args, environment);
  EXPECT_TRUE(line.ok()) << line.status();
  return line.ok() ? *line : CommandLine{};
}

std::string Refusal(const std::vector<std::string>& args) {
  const auto line = ParseCommandLine(args, "");
  EXPECT_FALSE(line.ok());
  const std::string text(line.status().message());
  EXPECT_EQ(text.find('\n'), std::string::npos) << text;
  return text;
}

TEST(CommandLine, Render) {
  const CommandLine line =
      Parse({"render", "a.gltf", "-o", "out.exr", "--workers", "3", "--threads", "2", "--json",
             "s.json", "--png", "p.png", "--quiet", "--log-level", "debug", "--exposure", "-1.5"});
  EXPECT_EQ(line.verb, Verb::kRender);
  EXPECT_EQ(line.scene, "a.gltf");
  EXPECT_EQ(line.output, "out.exr");
  EXPECT_EQ(line.workers, 3u);
  EXPECT_EQ(line.threads, 2u);
  EXPECT_EQ(line.json, "s.json");
  EXPECT_EQ(line.png, "p.png");
  EXPECT_TRUE(line.quiet);
  EXPECT_EQ(line.log_level, ConsoleLevel::kDebug);
  EXPECT_EQ(line.exposure_stops, -1.5f);
  EXPECT_TRUE(line.render_flags.empty());
}

TEST(CommandLine, EveryRenderFlagReachesTheJob) {
  for (const char* verb : {"render", "submit"}) {
    for (const RenderFlag& flag : RenderFlags()) {
      std::vector<std::string> args = {verb, "a.glb", "-o", "o.exr", "--quiet"};
      if (std::string(verb) == "submit") {
        args.insert(args.end(), {"--coordinator", "h:1"});
      }
      args.emplace_back(flag.name);
      if (!flag.metavar.empty()) args.emplace_back("value");
      EXPECT_THAT(Parse(args).render_flags,
                  ElementsAre(Pair(std::string(flag.name), flag.metavar.empty() ? "" : "value")));
    }
  }
}

TEST(CommandLine, ValuesMayBeNegativeOrJoined) {
  EXPECT_THAT(
      Parse({"render", "--eye", "-1,-2,3", "--target=-4,0,0", "a.glb", "-o", "o.exr"}).render_flags,
      ElementsAre(Pair("--eye", "-1,-2,3"), Pair("--target", "-4,0,0")));
}

TEST(CommandLine, RepeatedFlagsCountOnceOrAll) {
  EXPECT_THAT(
      Parse({"render", "a.glb", "-o", "o.exr", "--spp", "2", "--sun", "0,1,0:1,1,1", "--spp", "3",
             "--sun", "1,1,0:1,1,1"})
          .render_flags,
      ElementsAre(Pair("--spp", "3"), Pair("--sun", "0,1,0:1,1,1"), Pair("--sun", "1,1,0:1,1,1")));
}

TEST(CommandLine, FlagsDoNotSwallowTheScene) {
  const CommandLine line = Parse({"render", "--sun", "0,1,0:1,1,1", "a.glb", "-o", "o.exr"});
  EXPECT_EQ(line.scene, "a.glb");
}

TEST(CommandLine, Submit) {
  const CommandLine line = Parse({"submit", "a.json", "-o", "o.exr", "--coordinator", "farm:7420",
                                  "--patience", "5.5", "--title", "my job", "--priority", "-7"});
  EXPECT_EQ(line.verb, Verb::kSubmit);
  EXPECT_EQ(line.coordinator, "farm:7420");
  EXPECT_EQ(line.patience_s, 5.5);
  EXPECT_EQ(line.title, "my job");
  EXPECT_EQ(line.priority, -7);
  EXPECT_FALSE(line.farm_ignores);
  EXPECT_TRUE(Parse({"submit", "a.glb", "-o", "o.exr", "--coordinator", "h:1", "--workers", "2"})
                  .farm_ignores);
}

TEST(CommandLine, AViewerIsShownWhatArrivesHere) {
  for (const std::vector<std::string>& args :
       {std::vector<std::string>{"render", "a.glb", "-o", "o.exr"},
        {"submit", "a.glb", "-o", "o.exr", "--coordinator", "h:1"},
        {"fetch", "1", "-o", "o.exr", "--coordinator", "h:1"},
        {"watch", "1", "--coordinator", "h:1"}}) {
    std::vector<std::string> with = args;
    with.insert(with.end(), {"--display-server", "[::1]:14158"});
    EXPECT_EQ(Parse(with).display_server, "[::1]:14158");
    with.back() = "14158";
    EXPECT_THAT(Refusal(with), HasSubstr("--display-server 14158: expected HOST:PORT"));
  }
  EXPECT_THAT(
      Refusal({"submit", "a.glb", "--detach", "--coordinator", "h:1", "--display-server", "h:2"}),
      HasSubstr("with --detach no tile arrives here"));
  EXPECT_THAT(Refusal({"watch", "1", "2", "--coordinator", "h:1", "--display-server", "h:2"}),
              HasSubstr("shows one job"));
}

TEST(CommandLine, DetachNeedsNoOutputButTakesOne) {
  EXPECT_TRUE(Parse({"submit", "a.glb", "--detach", "--coordinator", "h:1"}).detach);
  const CommandLine line =
      Parse({"submit", "a.glb", "--detach", "-o", "o.####.exr", "--coordinator", "h:1"});
  EXPECT_TRUE(line.detach);
  EXPECT_EQ(line.output, "o.####.exr");
  EXPECT_THAT(Refusal({"submit", "a.glb", "--detach", "-o", "o.png", "--coordinator", "h:1"}),
              HasSubstr(".exr"));
}

TEST(CommandLine, SubmitMayWaitForOthersAndStartPaused) {
  const CommandLine line = Parse({"submit", "a.glb", "-o", "o.exr", "--coordinator", "h:1",
                                  "--after", "a1,b2", "--after=c3", "--paused"});
  EXPECT_THAT(line.after, ElementsAre("a1", "b2", "c3"));
  EXPECT_TRUE(line.paused);
  for (const char* list : {",", "a,", ",a", "a,,b"}) {
    EXPECT_THAT(Refusal({"submit", "a.glb", "--detach", "--coordinator", "h:1", "--after", list}),
                StartsWith("--after: "))
        << list;
  }
  std::string many = "a";
  for (int i = 0; i < 64; ++i) many += ",a";
  EXPECT_THAT(Refusal({"submit", "a.glb", "--detach", "--coordinator", "h:1", "--after", many}),
              HasSubstr("at most 64"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--after", "a"}),
              HasSubstr("unknown flag of farpoint render"));
}

TEST(CommandLine, Compression) {
  EXPECT_EQ(Parse({"render", "a.glb", "-o", "o.exr"}).compression, ExrCompression::kZip);
  EXPECT_EQ(Parse({"render", "a.glb", "-o", "o.exr", "--compression", "dwaa"}).compression,
            ExrCompression::kDwaa);
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--compression", "jpeg"}),
              AllOf(StartsWith("--compression jpeg: "), HasSubstr("zips")));
}

TEST(CommandLine, CoordinatorFromTheEnvironmentOrTheFlag) {
  EXPECT_EQ(Parse({"status"}, "env:1").coordinator, "env:1");
  EXPECT_EQ(Parse({"status", "--coordinator", "flag:2"}, "env:1").coordinator, "flag:2");
  EXPECT_EQ(Parse({"status", "--coordinator", "[::1]:7447"}).coordinator, "[::1]:7447");
  EXPECT_EQ(Parse({"status", "--coordinator", "my_farm-2.example:1"}).coordinator,
            "my_farm-2.example:1");
  EXPECT_THAT(Refusal({"status"}), HasSubstr("FARPOINT_COORDINATOR"));
  for (const char* address : {"host", "host:", ":1", "host:0", "host:65536", "host:1x", "ipv4:x:1",
                              "::1:7447", "unix:/run/x:1", "a b:1", "[::1]x:1"}) {
    EXPECT_THAT(Refusal({"status", "--coordinator", address}), HasSubstr("HOST:PORT")) << address;
  }
}

std::vector<std::string> OnFarm(std::vector<std::string> args) {
  args.insert(args.end(), {"--coordinator", "h:1"});
  return args;
}

TEST(CommandLine, CommandsOnJobsTakeAsManyAsTheyCanUse) {
  const CommandLine status = Parse(OnFarm({"status", "12ab", "--json", "-"}));
  EXPECT_EQ(status.verb, Verb::kStatus);
  EXPECT_THAT(status.jobs, ElementsAre("12ab"));
  EXPECT_EQ(status.json, "-");
  EXPECT_TRUE(Parse(OnFarm({"status"})).jobs.empty());
  EXPECT_THAT(Refusal(OnFarm({"status", "a", "b"})), HasSubstr("one argument too many"));

  const std::pair<const char*, Verb> several[] = {{"pause", Verb::kPause},
                                                  {"resume", Verb::kResume},
                                                  {"cancel", Verb::kCancel},
                                                  {"requeue", Verb::kRequeue},
                                                  {"watch", Verb::kWatch}};
  for (const auto& [name, verb] : several) {
    const CommandLine line = Parse(OnFarm({name, "a", "--quiet", "b"}));
    EXPECT_EQ(line.verb, verb);
    EXPECT_THAT(line.jobs, ElementsAre("a", "b")) << name;
    EXPECT_TRUE(line.quiet);
    if (verb != Verb::kWatch) {
      EXPECT_THAT(Refusal(OnFarm({name})), StartsWith("JOB: not given")) << name;
    }
  }
  EXPECT_TRUE(Parse(OnFarm({"watch"})).jobs.empty());
  EXPECT_TRUE(Parse(OnFarm({"requeue", "a", "--all"})).all);
  EXPECT_FALSE(Parse(OnFarm({"requeue", "a"})).all);

  for (const char* name : {"logs", "explain"}) {
    EXPECT_THAT(Parse(OnFarm({name, "a"})).jobs, ElementsAre("a"));
    EXPECT_THAT(Refusal(OnFarm({name})), StartsWith("JOB: not given"));
    EXPECT_THAT(Refusal(OnFarm({name, "a", "b"})), HasSubstr("one argument too many"));
  }
  EXPECT_TRUE(Parse(OnFarm({"logs", "a", "--follow"})).follow);
  EXPECT_EQ(Parse(OnFarm({"workers"})).verb, Verb::kWorkers);
  EXPECT_THAT(Refusal(OnFarm({"workers", "a"})), HasSubstr("one argument too many"));
}

TEST(CommandLine, Priority) {
  for (const char* number : {"-7", "7", "-1000", "0"}) {
    const CommandLine line = Parse(OnFarm({"priority", "12ab", number}));
    EXPECT_EQ(line.verb, Verb::kPriority);
    EXPECT_THAT(line.jobs, ElementsAre("12ab"));
    EXPECT_EQ(line.priority, std::stoi(number));
  }
  EXPECT_THAT(Refusal(OnFarm({"priority", "12ab"})), StartsWith("N: not given"));
  EXPECT_THAT(Refusal(OnFarm({"priority"})), StartsWith("JOB: not given"));
  EXPECT_THAT(Refusal(OnFarm({"priority", "12ab", "1001"})), StartsWith("N 1001: "));
  EXPECT_THAT(Refusal(OnFarm({"priority", "12ab", "high"})), StartsWith("N high: "));
  EXPECT_THAT(Refusal(OnFarm({"priority", "12ab", "1", "2"})), HasSubstr("too many"));
  EXPECT_THAT(Refusal(OnFarm({"priority", "12ab", "-x"})), HasSubstr("unknown flag"));
}

TEST(CommandLine, Fetch) {
  const CommandLine line =
      Parse(OnFarm({"fetch", "12ab", "-o", "o.##.exr", "--frames", "1-5x2", "--partial"}));
  EXPECT_EQ(line.verb, Verb::kFetch);
  EXPECT_THAT(line.frames, ElementsAre(1, 3, 5));
  EXPECT_TRUE(line.partial);
  EXPECT_TRUE(Parse(OnFarm({"fetch", "12ab", "-o", "o.exr", "--wait"})).wait);
  EXPECT_THAT(Refusal(OnFarm({"fetch", "x"})), StartsWith("-o: not given"));
  EXPECT_THAT(Refusal(OnFarm({"fetch", "-o", "o.exr"})), StartsWith("JOB: not given"));
  EXPECT_THAT(Refusal(OnFarm({"fetch", "x", "-o", "o.exr", "--frames", "5-"})),
              AllOf(StartsWith("--frames 5-: "), HasSubstr("1-10x2,15")));
  EXPECT_THAT(Refusal(OnFarm({"fetch", "x", "-o", "o.exr", "--partial", "--wait"})),
              StartsWith("--partial: "));
}

TEST(CommandLine, Compare) {
  const CommandLine line =
      Parse({"compare", "a.exr", "b.exr", "--layer", "irradiance", "--ref-layer", "E", "--mask",
             "m.npy", "--noise", "0.01", "--json", "c.json", "--diff", "d.png"});
  EXPECT_EQ(line.verb, Verb::kCompare);
  EXPECT_EQ(line.image_a, "a.exr");
  EXPECT_EQ(line.image_b, "b.exr");
  EXPECT_EQ(line.layer, "irradiance");
  EXPECT_EQ(line.ref_layer, "E");
  EXPECT_EQ(line.mask, "m.npy");
  EXPECT_EQ(line.noise, 0.01);
  EXPECT_EQ(line.diff, "d.png");
  EXPECT_THAT(Refusal({"compare", "a.exr"}), HasSubstr("two .exr"));
  EXPECT_THAT(Refusal({"compare", "a.exr", "b.exr", "--noise", "-1"}), StartsWith("--noise -1: "));
  EXPECT_THAT(Refusal({"compare", "a.exr", "b.exr", "--diff", "d.jpg"}),
              AllOf(StartsWith("--diff d.jpg: "), HasSubstr(".png")));
}

TEST(CommandLine, CertificatesAndTokens) {
  const CommandLine init =
      Parse({"certs", "init", "--dir", "d", "--server", "a,10.0.0.1", "--workers", "4", "--clients",
             "x,y", "--clients", "z", "--days", "30"});
  EXPECT_EQ(init.verb, Verb::kCerts);
  EXPECT_EQ(init.certs_action, CertsAction::kInit);
  EXPECT_EQ(init.certs_directory, "d");
  EXPECT_THAT(init.certs_hosts, ElementsAre("a", "10.0.0.1"));
  EXPECT_EQ(init.workers, 4u);
  EXPECT_THAT(init.certs_clients, ElementsAre("x", "y", "z"));
  EXPECT_EQ(init.certs_days, 30u);
  const CommandLine add = Parse({"certs", "add", "w9", "--role", "worker"});
  EXPECT_EQ(add.certs_action, CertsAction::kAdd);
  EXPECT_EQ(add.certs_name, "w9");
  EXPECT_EQ(add.certs_role, Role::kWorker);
  EXPECT_EQ(add.certs_directory, "farpoint-certs");
  EXPECT_EQ(Parse({"certs", "add", "s2", "--server", "h"}).certs_role, Role::kServer);
  EXPECT_EQ(Parse({"certs", "token", "t"}).certs_action, CertsAction::kToken);
  EXPECT_EQ(Parse({"certs", "revoke", "t"}).certs_action, CertsAction::kRevoke);
  EXPECT_EQ(Parse({"certs", "show"}).certs_action, CertsAction::kShow);
  EXPECT_THAT(Refusal({"certs"}), HasSubstr("ACTION"));
  EXPECT_THAT(Refusal({"certs", "make"}), HasSubstr("unknown action"));
  EXPECT_THAT(Refusal({"certs", "add"}), HasSubstr("NAME"));
  EXPECT_THAT(Refusal({"certs", "show", "x"}), HasSubstr("one argument too many"));
  EXPECT_THAT(Refusal({"certs", "token", "x", "--role", "worker"}), HasSubstr("--role"));
  EXPECT_THAT(Refusal({"certs", "add", "x", "--role", "king"}), HasSubstr("--role king"));
  EXPECT_THAT(Refusal({"certs", "add", "x", "--role", "worker", "--server", "h"}),
              HasSubstr("--server"));
  EXPECT_THAT(Refusal({"certs", "init", "--days", "0"}), HasSubstr("--days"));
}

TEST(CommandLine, EveryCommandThatAsksACoordinatorSpeaksTls) {
  for (const std::vector<std::string>& command : {std::vector<std::string>{"status"},
                                                  {"watch"},
                                                  {"workers"},
                                                  {"logs", "1"},
                                                  {"explain", "1"},
                                                  {"cancel", "1"},
                                                  {"fetch", "1", "-o", "x.exr"},
                                                  {"submit", "a.glb", "-o", "x.exr"},
                                                  {"doctor"}}) {
    std::vector<std::string> args = command;
    args.insert(args.end(), {"--coordinator", "h:1", "--tls-ca", "c", "--tls-cert", "p",
                             "--tls-key", "k", "--token-file", "t", "--insecure"});
    const CommandLine line = Parse(args);
    EXPECT_EQ(line.tls.paths.ca, "c") << command[0];
    EXPECT_EQ(line.tls.paths.certificate, "p");
    EXPECT_EQ(line.tls.paths.key, "k");
    EXPECT_EQ(line.token_file, "t");
    EXPECT_TRUE(line.tls.insecure);
    args = command;
    args.insert(args.end(), {"--coordinator", "h:1", "--certs", "dir"});
    EXPECT_EQ(Parse(args).tls.directory, "dir");
  }
}

TEST(CommandLine, TheDoctorNeedsNothing) {
  const CommandLine bare = Parse({"doctor"});
  EXPECT_EQ(bare.verb, Verb::kDoctor);
  EXPECT_EQ(bare.coordinator, "");
  const CommandLine line =
      Parse({"doctor", "a.glb", "--role", "worker", "--store", "s", "--cache", "c", "--blob-dir",
             "b", "--listen", "h:1", "--points", "5000000000"});
  EXPECT_EQ(line.scene, "a.glb");
  EXPECT_EQ(line.doctor_role, Role::kWorker);
  EXPECT_EQ(line.store + line.cache + line.blob_dir + line.listen, "scbh:1");
  EXPECT_EQ(line.points, 5'000'000'000u);
  EXPECT_THAT(Refusal({"doctor", "--coordinator", "nowhere"}), HasSubstr("--coordinator"));
}

TEST(CommandLine, HelpAndVersionPrintAndNeedNothingElse) {
  for (const char* verb :
       {"render", "submit", "status", "watch", "fetch", "pause", "resume", "cancel", "requeue",
        "priority", "workers", "logs", "explain", "compare"}) {
    const CommandLine line = Parse({verb, "--help"});
    ASSERT_TRUE(line.print.has_value());
    EXPECT_THAT(*line.print, HasSubstr("--log-level"));
    EXPECT_THAT(*line.print, StartsWith(std::string("farpoint ") + verb));
    EXPECT_THAT(*Parse({"--help"}).print, HasSubstr(verb));
  }
  for (const RenderFlag& flag : RenderFlags()) {
    EXPECT_THAT(*Parse({"render", "-h"}).print, HasSubstr(std::string(flag.name)));
  }
  EXPECT_THAT(*Parse({"--version"}).print, StartsWith("farpoint " FARPOINT_VERSION));
}

TEST(CommandLine, NamesTheNearestCommandAndFlag) {
  EXPECT_THAT(Refusal({"rendr"}), HasSubstr("did you mean render?"));
  EXPECT_THAT(Refusal({"xyzzy"}), HasSubstr("farpoint --help"));
  EXPECT_THAT(Refusal({}), HasSubstr("farpoint --help"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--resolutoin", "4x4"}),
              AllOf(StartsWith("--resolutoin: "), HasSubstr("did you mean --resolution?")));
  EXPECT_THAT(Refusal({"render", "--resolutoin=4x4", "a.glb", "-o", "o.exr"}),
              HasSubstr("did you mean --resolution?"));
  EXPECT_THAT(Refusal({"status", "--spp", "4"}), HasSubstr("unknown flag of farpoint status"));
}

TEST(CommandLine, SaysWhatAValueIsMissingFor) {
  EXPECT_THAT(Refusal({"render", "a.glb", "-o"}), StartsWith("-o: needs a value"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--spp"}),
              StartsWith("--spp: needs a value"));
  EXPECT_THAT(Refusal({"render", "a.glb", "--png", "--quiet", "-o", "o.exr"}),
              StartsWith("--png: needs a value"));
  EXPECT_THAT(Refusal({"render", "--spp=", "a.glb", "-o", "o.exr"}),
              StartsWith("--spp: needs a value"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--no-skip=true"}),
              StartsWith("--no-skip: is a switch"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--config", "/nowhere", "--tile"}),
              StartsWith("--tile: needs a value"));
}

TEST(CommandLine, RefusesWhatIsMissingTooMuchOrWrong) {
  EXPECT_THAT(Refusal({"render", "-o", "o.exr"}), StartsWith("SCENE: not given"));
  EXPECT_THAT(Refusal({"render", "a.glb"}), StartsWith("-o: not given"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.png"}), HasSubstr(".exr"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--png", "o.jpg"}), HasSubstr(".png"));
  EXPECT_THAT(Refusal({"render", "a.glb", "b.glb", "-o", "o.exr"}),
              HasSubstr("one argument too many"));
  EXPECT_THAT(Refusal({"render", "a.xyz", "-o", "o.exr"}), HasSubstr(".gltf"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--workers", "0"}),
              StartsWith("--workers 0: expected a whole number from 1 to 256"));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--threads", "two"}),
              StartsWith("--threads two: "));
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--log-level", "loud"}),
              StartsWith("--log-level loud: "));
}

class ConfigFile : public testing::Test {
 protected:
  std::string Write(const std::string& text) { return folder_.Write("f.conf", text); }
  TempFolder folder_;
};

TEST_F(ConfigFile, GivesFlagsThatTheCommandLineOverrides) {
  const std::string path = Write(
      "# a comment\nspp = 4\n\n  tile=64 \r\nno-skip = true\n"
      "quiet = false\noutput = \"from file.exr\"\n; another\n");
  const CommandLine line = Parse({"render", "a.glb", "--config", path, "--spp", "8"});
  EXPECT_THAT(line.render_flags,
              ElementsAre(Pair("--spp", "8"), Pair("--tile", "64"), Pair("--no-skip", "")));
  EXPECT_FALSE(line.quiet);
  EXPECT_EQ(line.output, "from file.exr");
}

TEST_F(ConfigFile, NamesFileLineAndNearestName) {
  const std::string path = Write("spp = 4\ntiel = 64\n");
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--config", path}),
              AllOf(StartsWith(path + ":2: "), HasSubstr("did you mean --tile?")));
}

TEST_F(ConfigFile, RefusesWhatIsNoSetting) {
  for (const char* text : {"spp\n", "no-skip = yes\n", "config = other\n", "help = true\n",
                           "[render]\n", "filling = cut\n", "spp =\n", "spp = \"\"\n"}) {
    const std::string path = Write(text);
    EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--config", path}),
                StartsWith(path + ":1: "))
        << text;
  }
  EXPECT_THAT(Refusal({"render", "a.glb", "-o", "o.exr", "--config", "/nowhere/x"}),
              HasSubstr("/nowhere/x"));
}

}  // namespace
}  // namespace farpoint
