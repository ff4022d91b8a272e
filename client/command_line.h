// The command line as a value. The only include of CLI11 is in the .cc.
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "client/console.h"
#include "client/render_flags.h"
#include "core/base/status.h"
#include "core/image/exr_io.h"
#include "proto/access.h"
#include "proto/tls_files.h"

namespace farpoint {

enum class Verb {
  kRender,
  kSubmit,
  kStatus,
  kWatch,
  kFetch,
  kPause,
  kResume,
  kCancel,
  kRequeue,
  kPriority,
  kWorkers,
  kLogs,
  kExplain,
  kCompare,
  kCerts,
  kDoctor,
};

// farpoint certs ACTION
enum class CertsAction { kInit, kAdd, kShow, kToken, kRevoke };

struct CommandLine {
  Verb verb = Verb::kRender;
  // --help or --version: print this to stdout and be done; nothing else is set.
  std::optional<std::string> print;

  ConsoleLevel log_level = ConsoleLevel::kInfo;
  bool quiet = false;
  std::string json;         // file for statistics or status; "-": stdout; empty: none
  std::string coordinator;  // HOST:PORT
  double patience_s = 60;   // how long an unreachable coordinator is waited for
  TlsFlags tls;
  std::string token_file;  // empty: none

  // render, submit
  std::string scene;
  std::vector<GivenFlag> render_flags;
  uint32_t workers = 1;       // render: embedded workers
  uint32_t threads = 0;       // render: of each worker; 0: all cores
  bool farm_ignores = false;  // submit was given --workers or --threads

  // submit
  bool detach = false;
  bool paused = false;
  std::optional<std::string> title;
  std::vector<std::string> after;  // ids of jobs

  // submit, priority
  std::optional<int32_t> priority;

  // render, submit, fetch
  std::string output;  // .exr
  std::string png;     // empty: no preview
  float exposure_stops = 0;
  ExrCompression compression = ExrCompression::kZip;

  // render, submit, fetch, watch of one job
  std::string display_server;  // HOST:PORT of a viewer; empty: none

  // fetch
  std::vector<int32_t> frames;  // empty: all
  bool partial = false;
  bool wait = false;

  // Ids: status at most one; fetch, priority, logs and explain exactly one; pause, resume, cancel
  // and requeue at least one; watch any number.
  std::vector<std::string> jobs;
  bool all = false;     // requeue
  bool follow = false;  // logs

  // compare
  std::string image_a, image_b;
  std::string layer, ref_layer, mask;
  std::string diff;  // false-colour PNG; empty: none
  double noise = 0;

  // certs
  CertsAction certs_action = CertsAction::kShow;
  std::string certs_directory;
  std::string certs_name;                  // add, token, revoke
  Role certs_role = Role::kClient;         // add, token
  std::vector<std::string> certs_hosts;    // init, add
  std::vector<std::string> certs_clients;  // init
  uint32_t certs_days = 365;

  // doctor; all may be empty
  std::string store, cache, blob_dir, listen;
  uint64_t points = 0;
  Role doctor_role = Role::kClient;  // whose certificate of --certs is looked at
};

// `args` without the program's name. `environment_coordinator` stands in for --coordinator. Every
// error is a usage error (exit code 2) in one line: what, where, what to do. Reads the file of
// --config; render flags are recognised here but their values are checked by ApplyRenderFlags.
absl::StatusOr<CommandLine> ParseCommandLine(std::span<const std::string> args,
                                             const std::string& environment_coordinator);

}  // namespace farpoint
