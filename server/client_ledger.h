// Which client submitted which job and stored which blobs: what a coordinator that knows its
// clients (TLS) limits for each of them, and whose jobs a client may change. A small SQLite file
// beside the store, or memory. A blob counts for the first one who sent it, until it is gone from
// the store. A job of which nothing is known (the process died just after it was submitted) is
// nobody's: admins may change it. Thread-safe.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/base/hash.h"
#include "core/base/status.h"
#include "proto/job.h"

struct sqlite3;

namespace farpoint {

struct ClientLedgerOptions {
  std::string path;  // created if absent; empty: in memory
  // Whether a blob is still there; must not count as a use of it.
  std::function<bool(const Digest&)> has_blob;
  // Whether a job has not ended; none: it is not known any more.
  std::function<std::optional<bool>(const JobId&)> is_active;
  uint64_t max_jobs = 0;   // of a client, not ended; 0: no limit
  uint64_t max_bytes = 0;  // of a client's blobs; 0: no limit
};

class ClientLedger {
 public:
  // kUnavailable names the file.
  static absl::StatusOr<std::unique_ptr<ClientLedger>> Open(ClientLedgerOptions options);
  ~ClientLedger();
  ClientLedger(const ClientLedger&) = delete;
  ClientLedger& operator=(const ClientLedger&) = delete;

  struct Use {
    uint64_t jobs = 0;   // not ended
    uint64_t bytes = 0;  // of blobs, those gone meanwhile not counted
  };
  absl::StatusOr<Use> UseOf(const std::string& client);

  // kResourceExhausted if the client has as many jobs as it may. Two submissions at the same moment
  // may both pass.
  absl::Status MaySubmit(const std::string& client);
  absl::Status Submitted(const std::string& client, const JobId& job);
  // A transfer that was announced: its bytes count for as long as this lives, whoever else sends
  // at the same time. The ledger must outlive it.
  class Transfer {
   public:
    ~Transfer();
    Transfer(const Transfer&) = delete;
    Transfer& operator=(const Transfer&) = delete;

   private:
    friend class ClientLedger;
    Transfer(ClientLedger& ledger, std::string client, uint64_t bytes)
        : ledger_(ledger), client_(std::move(client)), bytes_(bytes) {}
    ClientLedger& ledger_;
    const std::string client_;
    const uint64_t bytes_;
  };
  // kResourceExhausted if `bytes` more would be too many, with what is on its way.
  absl::StatusOr<std::unique_ptr<Transfer>> BeginTransfer(const std::string& client,
                                                          uint64_t bytes);
  absl::Status Stored(const std::string& client, const Digest& digest, uint64_t bytes);
  // Empty: not known.
  std::string OwnerOf(const JobId& job);

 private:
  ClientLedger(sqlite3* database, ClientLedgerOptions options)
      : database_(database), options_(std::move(options)) {}
  // Under mutex_, as all below.
  absl::StatusOr<uint64_t> ActiveJobs(const std::string& client);
  absl::StatusOr<uint64_t> BytesCounted(const std::string& client);
  // The same, but for what has left the store.
  absl::StatusOr<uint64_t> BytesStored(const std::string& client);
  absl::StatusOr<std::vector<std::string>> Column(const char* sql, const std::string& client);

  std::mutex mutex_;
  sqlite3* const database_;                     // guarded by mutex_
  std::map<std::string, uint64_t> on_the_way_;  // bytes by client; guarded by mutex_
  const ClientLedgerOptions options_;
};

}  // namespace farpoint
