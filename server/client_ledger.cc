#include "server/client_ledger.h"

#include <sqlite3.h>

#include <utility>

namespace farpoint {

namespace {

class Statement {
 public:
  Statement(sqlite3* database, const char* sql) : database_(database) {
    failed_ = sqlite3_prepare_v2(database, sql, -1, &statement_, nullptr) != SQLITE_OK;
  }
  ~Statement() { sqlite3_finalize(statement_); }
  Statement(const Statement&) = delete;
  Statement& operator=(const Statement&) = delete;

  Statement& Bind(int at, const std::string& text) {
    failed_ =
        failed_ || sqlite3_bind_text(statement_, at, text.data(), static_cast<int>(text.size()),
                                     SQLITE_TRANSIENT) != SQLITE_OK;
    return *this;
  }
  Statement& Bind(int at, uint64_t number) {
    failed_ =
        failed_ || sqlite3_bind_int64(statement_, at, static_cast<int64_t>(number)) != SQLITE_OK;
    return *this;
  }
  // True: a row; false: done.
  absl::StatusOr<bool> Step() {
    const int code = failed_ ? SQLITE_ERROR : sqlite3_step(statement_);
    if (code == SQLITE_ROW) return true;
    if (code == SQLITE_DONE) return false;
    return absl::UnavailableError(std::string("the list of clients cannot be used: ") +
                                  sqlite3_errmsg(database_) + "; is the disk full?");
  }
  uint64_t Number(int column) {
    return static_cast<uint64_t>(sqlite3_column_int64(statement_, column));
  }
  std::string Text(int column) {
    const auto* text = sqlite3_column_text(statement_, column);
    return text == nullptr ? std::string() : std::string(reinterpret_cast<const char*>(text));
  }

 private:
  sqlite3* database_;
  sqlite3_stmt* statement_ = nullptr;
  bool failed_ = false;
};

// A lost line counts too little for somebody, and no job or pixel: not worth waiting for the disk.
constexpr const char* kSchema =
    "PRAGMA journal_mode=WAL; PRAGMA synchronous=NORMAL; PRAGMA busy_timeout=2000;"
    "CREATE TABLE IF NOT EXISTS blobs("
    "digest TEXT PRIMARY KEY, client TEXT NOT NULL, bytes INTEGER NOT NULL);"
    "CREATE INDEX IF NOT EXISTS blobs_of ON blobs(client);"
    "CREATE TABLE IF NOT EXISTS jobs(id TEXT PRIMARY KEY, client TEXT NOT NULL);"
    "CREATE INDEX IF NOT EXISTS jobs_of ON jobs(client);";

}  // namespace

absl::StatusOr<std::unique_ptr<ClientLedger>> ClientLedger::Open(ClientLedgerOptions options) {
  sqlite3* database = nullptr;
  const int flags = SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE | SQLITE_OPEN_NOMUTEX;
  const char* const name = options.path.empty() ? ":memory:" : options.path.c_str();
  const bool made = sqlite3_open_v2(name, &database, flags, nullptr) == SQLITE_OK &&
                    sqlite3_exec(database, kSchema, nullptr, nullptr, nullptr) == SQLITE_OK;
  if (!made) {
    const std::string why = database == nullptr ? "no memory" : sqlite3_errmsg(database);
    sqlite3_close(database);
    return absl::UnavailableError("'" + options.path +
                                  "': cannot be opened as the list of clients: " + why +
                                  "; free the disk, or remove the file, which is then made anew");
  }
  return std::unique_ptr<ClientLedger>(new ClientLedger(database, std::move(options)));
}

ClientLedger::~ClientLedger() { sqlite3_close(database_); }

absl::StatusOr<std::vector<std::string>> ClientLedger::Column(const char* sql,
                                                              const std::string& client) {
  std::vector<std::string> values;
  Statement all(database_, sql);
  all.Bind(1, client);
  for (;;) {
    FP_ASSIGN_OR_RETURN(const bool row, all.Step());
    if (!row) return values;
    values.push_back(all.Text(0));
  }
}

absl::StatusOr<uint64_t> ClientLedger::ActiveJobs(const std::string& client) {
  FP_ASSIGN_OR_RETURN(const std::vector<std::string> ids,
                      Column("SELECT id FROM jobs WHERE client = ?1", client));
  uint64_t active = 0;
  for (const std::string& id : ids) {
    const std::optional<bool> state = options_.is_active(JobId{id});
    if (state) {
      active += *state ? 1 : 0;
      continue;
    }
    Statement remove(database_, "DELETE FROM jobs WHERE id = ?1");
    FP_RETURN_IF_ERROR(remove.Bind(1, id).Step().status());
  }
  return active;
}

absl::StatusOr<uint64_t> ClientLedger::BytesCounted(const std::string& client) {
  Statement sum(database_, "SELECT COALESCE(SUM(bytes), 0) FROM blobs WHERE client = ?1");
  FP_ASSIGN_OR_RETURN(const bool row, sum.Bind(1, client).Step());
  return row ? sum.Number(0) : 0;
}

absl::StatusOr<uint64_t> ClientLedger::BytesStored(const std::string& client) {
  FP_ASSIGN_OR_RETURN(const std::vector<std::string> names,
                      Column("SELECT digest FROM blobs WHERE client = ?1", client));
  for (const std::string& hex : names) {
    const absl::StatusOr<Digest> digest = Digest::FromHex(hex);
    if (digest.ok() && options_.has_blob(*digest)) continue;
    Statement remove(database_, "DELETE FROM blobs WHERE digest = ?1");
    FP_RETURN_IF_ERROR(remove.Bind(1, hex).Step().status());
  }
  return BytesCounted(client);
}

absl::StatusOr<ClientLedger::Use> ClientLedger::UseOf(const std::string& client) {
  std::lock_guard lock(mutex_);
  Use use;
  FP_ASSIGN_OR_RETURN(use.jobs, ActiveJobs(client));
  FP_ASSIGN_OR_RETURN(use.bytes, BytesStored(client));
  return use;
}

absl::Status ClientLedger::MaySubmit(const std::string& client) {
  if (options_.max_jobs == 0) return absl::OkStatus();
  std::lock_guard lock(mutex_);
  FP_ASSIGN_OR_RETURN(const uint64_t jobs, ActiveJobs(client));
  if (jobs < options_.max_jobs) return absl::OkStatus();
  return absl::ResourceExhaustedError(
      "'" + client + "' has " + std::to_string(jobs) + " jobs that have not ended; the limit is " +
      std::to_string(options_.max_jobs) + ", wait for one or cancel one");
}

absl::Status ClientLedger::Submitted(const std::string& client, const JobId& job) {
  std::lock_guard lock(mutex_);
  Statement insert(database_,
                   "INSERT INTO jobs(id, client) VALUES(?1, ?2) ON CONFLICT(id) DO NOTHING");
  return insert.Bind(1, job.value).Bind(2, client).Step().status();
}

absl::StatusOr<std::unique_ptr<ClientLedger::Transfer>> ClientLedger::BeginTransfer(
    const std::string& client, uint64_t bytes) {
  std::lock_guard lock(mutex_);
  uint64_t& moving = on_the_way_[client];
  const uint64_t limit = options_.max_bytes == 0 ? UINT64_MAX : options_.max_bytes;
  const auto fits = [&](uint64_t stored) {
    return stored <= limit && moving <= limit - stored && bytes <= limit - stored - moving;
  };
  uint64_t stored = 0;
  if (options_.max_bytes != 0) {
    FP_ASSIGN_OR_RETURN(stored, BytesCounted(client));
    // Only if it is too much is it worth looking for what has left the store.
    if (!fits(stored)) {
      FP_ASSIGN_OR_RETURN(stored, BytesStored(client));
    }
  }
  if (!fits(stored)) {
    return absl::ResourceExhaustedError(
        "'" + client + "' stores " + std::to_string(stored) + " bytes here and sends " +
        std::to_string(moving) + ", and " + std::to_string(bytes) +
        " more would be above the limit of " + std::to_string(limit) +
        "; wait until older jobs are purged, or send less");
  }
  moving += bytes;
  return std::unique_ptr<Transfer>(new Transfer(*this, client, bytes));
}

ClientLedger::Transfer::~Transfer() {
  std::lock_guard lock(ledger_.mutex_);
  const auto at = ledger_.on_the_way_.find(client_);
  if ((at->second -= bytes_) == 0) ledger_.on_the_way_.erase(at);
}

absl::Status ClientLedger::Stored(const std::string& client, const Digest& digest, uint64_t bytes) {
  std::lock_guard lock(mutex_);
  Statement insert(database_,
                   "INSERT INTO blobs(digest, client, bytes) VALUES(?1, ?2, ?3) "
                   "ON CONFLICT(digest) DO NOTHING");
  return insert.Bind(1, digest.Hex()).Bind(2, client).Bind(3, bytes).Step().status();
}

std::string ClientLedger::OwnerOf(const JobId& job) {
  std::lock_guard lock(mutex_);
  Statement one(database_, "SELECT client FROM jobs WHERE id = ?1");
  const absl::StatusOr<bool> row = one.Bind(1, job.value).Step();
  return row.ok() && *row ? one.Text(0) : std::string();
}

}  // namespace farpoint
