#include <sys/mman.h>
#include <unistd.h>

#include <chrono>
#include <cstdlib>
#include <string>
#include <vector>

#include "client/command_line.h"
#include "client/frame_path.h"
#include "client/frame_range.h"
#include "proto/access.h"
#include "proto/certificate.h"
#include "proto/convert.h"
#include "proto/farpoint.pb.h"
#include "proto/job.h"
#include "tests/fuzz/fuzz_target.h"

namespace farpoint {

namespace {

JobSpec SmallJob() {
  JobSpec job;
  job.film = {64, 48, {0, 0, 64, 48}};
  return job;
}

bool RunJobFile(std::span<const std::byte> bytes) {
  const auto wire = RenderJobFromJson(TextOf(bytes), "job.json");
  if (!wire.ok()) return false;
  const auto job = JobFromWire(*wire);
  if (!job.ok()) return false;
  // What was accepted is accepted again as it is written.
  FuzzRequire(JobFromWire(ToWire(*job)).ok(), "a job that was read can be sent");
  const auto again = RenderJobFromJson(RenderJobToJson(ToWire(*job)), "again.json");
  FuzzRequire(again.ok(), "a job that was read can be written and read");
  return true;
}

std::vector<FuzzBytes> JobFileSeeds() {
  return {
      BytesOf(RenderJobToJson(ToWire(SmallJob()))),
      BytesOf(R"({"film":{"width_px":64,"height_px":48},"settings":{"integrator":"INTEGRATOR_PT",)"
              R"("paths":7,"layers":["beauty","N"]},"overrides":{"sky":{"r":1,"g":2,"b":3},)"
              R"("suns":[{"to_sun":{"y":1},"irradiance":{"r":3,"g":3,"b":3}}]}})")};
}

// The first byte chooses the message, the others are it.
template <typename Wire, typename Read>
bool RunOne(std::span<const std::byte> bytes, const Read& read) {
  Wire wire;
  if (!wire.ParseFromArray(bytes.data(), static_cast<int>(bytes.size()))) return false;
  return read(wire);
}

// Reads, and if that goes well, writes and reads once more.
template <typename Wire, typename FromWire>
bool RunBoth(std::span<const std::byte> bytes, const FromWire& from_wire) {
  return RunOne<Wire>(bytes, [&](const Wire& wire) {
    const auto value = from_wire(wire);
    if (!value.ok()) return false;
    FuzzRequire(from_wire(ToWire(*value)).ok(), "a message that was read can be sent");
    return true;
  });
}

bool RunMessage(std::span<const std::byte> bytes) {
  if (bytes.empty()) return false;
  const auto kind = std::to_integer<unsigned>(bytes.front());
  bytes = bytes.subspan(1);
  switch (kind) {
    case 0:
      return RunBoth<v1::RenderJob>(bytes, JobFromWire);
    case 1:
      return RunBoth<v1::JobStatus>(bytes, JobStatusFromWire);
    case 2:
      return RunBoth<v1::WorkerStatus>(bytes, WorkerStatusFromWire);
    case 3:
      return RunBoth<v1::JobEvent>(bytes, JobEventFromWire);
    case 4:
      return RunBoth<v1::LogLine>(bytes, LogLineFromWire);
    case 5:
      return RunBoth<v1::ExplainResponse>(bytes, ExplanationFromWire);
    case 6:
      return RunBoth<v1::FetchInfoResponse>(bytes, JobInfoFromWire);
    case 7:
      return RunBoth<v1::RegisterRequest>(bytes, HelloFromWire);
    case 8:
      return RunBoth<v1::RegisterResponse>(bytes, WelcomeFromWire);
    case 9:
      return RunBoth<v1::TileWork>(bytes, TileWorkFromWire);
    case 10:
      return RunBoth<v1::Stats>(bytes, StatsFromWire);
    case 11:
      return RunBoth<v1::SceneBlobs>(bytes, SceneBlobsFromWire);
    case 12:
      return RunOne<v1::ReturnHeader>(bytes, [](const v1::ReturnHeader& wire) {
        const auto head = ReturnHeadFromWire(wire, 1 << 20);
        if (head.ok()) FuzzRequire(head->size_bytes <= 1 << 20, "sizes are bounded");
        return head.ok();
      });
    case 13:
      return RunBoth<v1::DiagnoseResponse>(bytes, HealthFromWire);
    case 14:
      return RunOne<v1::RenderJob>(
          bytes, [](const v1::RenderJob& wire) { return CheckFieldsKnown(wire, "job").ok(); });
    default:
      return false;
  }
}

// What a coordinator reads of its own folder, and of a stranger: tokens, revoked serials,
// certificates.
bool RunSecrets(std::span<const std::byte> bytes) {
  const std::string_view text = TextOf(bytes);
  const auto tokens = ParseTokens(text, "tokens");
  if (tokens.ok()) {
    std::string again;
    for (const TokenEntry& token : *tokens) again += FormatToken(token);
    FuzzRequire(ParseTokens(again, "again").ok(), "tokens that were read can be written and read");
  }
  const bool revoked = ParseRevoked(text, "revoked").ok();
  const auto facts = ReadCertificate(text, "certificate");
  if (facts.ok()) {
    for (const char c : facts->name)
      FuzzRequire(c >= ' ' && c <= '~', "names are shown and logged");
  }
  (void)CheckIssued(text, text, false, 1'800'000'000);
  (void)CheckHost(text, "farm.example");
  return tokens.ok() || revoked || facts.ok();
}

std::vector<FuzzBytes> SecretsSeeds() {
  std::vector<FuzzBytes> seeds = {
      BytesOf(FormatToken({TokenHash("fp_"), "carol", Role::kAdmin, 1'900'000'000})),
      BytesOf("0badcafe alice 2026-11-22\n")};
  if (const auto authority = MakeAuthority("farm", 1'700'000'000, 1'900'000'000); authority.ok()) {
    seeds.push_back(BytesOf(authority->certificate));
  }
  return seeds;
}

template <typename Wire>
FuzzBytes Message(unsigned kind, const Wire& wire) {
  return BytesOf(std::string(1, static_cast<char>(kind)) + wire.SerializeAsString());
}

std::vector<FuzzBytes> MessageSeeds() {
  WorkerHello hello;
  hello.version = "1";
  hello.fingerprint = HashBytes(BytesOf("fingerprint"));
  hello.name = "seed";
  Explanation explanation{{"one line", "another"}};
  Stats stats;
  stats.seconds[0] = 1;
  stats.counts["surfels"] = 7;
  const SceneBlobs blobs{hello.fingerprint, hello.fingerprint, {}};
  JobStatus status;
  status.id = JobId{"0123456789abcdef0123456789abcdef"};
  TileWork work;
  work.lease = LeaseId{"0123456789abcdef0123456789abcdef"};
  work.job = status.id;
  work.attempt = 1;
  work.rect = {0, 0, 32, 32};
  work.frame.film = {64, 48, {0, 0, 64, 48}};
  work.blobs = blobs;
  work.lease_time = std::chrono::milliseconds(1000);
  CoordinatorHealth health;
  health.version = "1";
  health.caller_name = "alice";
  WorkerWelcome welcome;
  welcome.id = WorkerId{"0123456789abcdef0123456789abcdef"};
  return {Message(0, ToWire(SmallJob())),  Message(1, ToWire(status)),
          Message(5, ToWire(explanation)), Message(7, ToWire(hello)),
          Message(8, ToWire(welcome)),     Message(9, ToWire(work)),
          Message(10, ToWire(stats)),      Message(11, ToWire(blobs)),
          Message(13, ToWire(health)),     Message(14, ToWire(SmallJob()))};
}

bool RunConfig(std::span<const std::byte> bytes) {
  const int fd = memfd_create("fuzz", 0);
  if (fd < 0 || ::write(fd, bytes.data(), bytes.size()) != static_cast<ssize_t>(bytes.size())) {
    std::abort();
  }
  const std::vector<std::string> args = {
      "render", "scene.gltf", "-o", "out.exr", "--config", "/proc/self/fd/" + std::to_string(fd)};
  const bool ok = ParseCommandLine(args, "").ok();
  ::close(fd);
  return ok;
}

std::vector<FuzzBytes> ConfigSeeds() {
  return {BytesOf("# a comment\nresolution=64x48\nspp = 4\n\naov=beauty,N\n"),
          BytesOf("no-skip=true\nsun=0,1,0:1,1,1\n")};
}

bool RunFrames(std::span<const std::byte> bytes) {
  const std::string text(TextOf(bytes));
  const bool path = FramePath::Parse(text).ok();
  const auto frames = ParseFrameRange(text);
  return frames.ok() || path;
}

std::vector<FuzzBytes> FramesSeeds() {
  return {BytesOf("1-10x2,15"), BytesOf("-5--1"), BytesOf("out.####.exr")};
}

constexpr FuzzTarget kTargets[] = {
    {"job_file", RunJobFile, JobFileSeeds}, {"message", RunMessage, MessageSeeds},
    {"config", RunConfig, ConfigSeeds},     {"frames", RunFrames, FramesSeeds},
    {"secrets", RunSecrets, SecretsSeeds},
};

}  // namespace

std::span<const FuzzTarget> WireFuzzTargets() { return kTargets; }

}  // namespace farpoint
