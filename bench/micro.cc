#include "bench/micro.h"

#include <filesystem>
#include <memory>
#include <mutex>
#include <ostream>
#include <vector>

#include "bench/micro_workload.h"
#include "core/base/blob.h"

namespace farpoint {

namespace {

// Google Benchmark takes its settings from a command line only.
void Initialize(const MicroOptions& options, const std::string& part) {
  std::vector<std::string> args = {
      "farpoint-bench",
      "--benchmark_out=" + part,
      "--benchmark_out_format=json",
      // Seconds a benchmark runs at least.
      std::string("--benchmark_min_time=") + (options.quick ? "0.001" : "0.5"),
      "--benchmark_filter=" + (options.filter.empty() ? "." : options.filter),
  };
  std::vector<char*> argv;
  for (std::string& arg : args) argv.push_back(arg.data());
  int argc = static_cast<int>(argv.size());
  benchmark::Initialize(&argc, argv.data());
}

// What the JSON says of the run beside the machine. The library keeps it for the whole process and
// complains about a second time.
void AddContextOnce(const MicroOptions& options, const MicroWorkload& work) {
  static std::once_flag once;
  std::call_once(once, [&] {
    benchmark::AddCustomContext("farpoint_version", FARPOINT_VERSION);
    benchmark::AddCustomContext("surfels", std::to_string(work.cloud.size()));
    benchmark::AddCustomContext("receivers", std::to_string(work.receivers.size()));
    benchmark::AddCustomContext("quick", options.quick ? "true" : "false");
  });
}

}  // namespace

absl::Status RunMicro(const MicroOptions& options, std::ostream& out) {
  // The library ends the process if it cannot write: try it first.
  const std::string part = options.json_path + ".part";
  FP_RETURN_IF_ERROR(WriteFileAtomically(part, {}));
  FP_ASSIGN_OR_RETURN(const std::unique_ptr<MicroWorkload> work,
                      MicroWorkload::Make(options.quick));
  benchmark::ClearRegisteredBenchmarks();
  Initialize(options, part);
  AddContextOnce(options, *work);
  RegisterReceiverClusterBenchmarks(*work);
  RegisterTreeCutBenchmarks(*work);
  RegisterMicrobufferBenchmarks(*work);
  RegisterPointTreeBenchmarks(*work);
  RegisterSurfelBenchmarks(*work);
  RegisterRayAccelBenchmarks(*work);
  RegisterPathTracerBenchmarks(*work);
  benchmark::ConsoleReporter console(benchmark::ConsoleReporter::OO_Tabular);
  console.SetOutputStream(&out);
  const size_t ran = benchmark::RunSpecifiedBenchmarks(&console);
  benchmark::ClearRegisteredBenchmarks();
  std::error_code error;
  if (ran == 0) {
    std::filesystem::remove(part, error);
    return absl::InvalidArgumentError("no benchmark's name matches --filter " + options.filter);
  }
  std::filesystem::rename(part, options.json_path, error);
  if (error) {
    return absl::UnavailableError(options.json_path + ": cannot be written: " + error.message());
  }
  return absl::OkStatus();
}

}  // namespace farpoint
