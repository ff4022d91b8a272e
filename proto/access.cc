#include "proto/access.h"

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cstdio>
#include <ctime>

namespace farpoint {

namespace {

constexpr std::array<std::string_view, 5> kRoleNames = {"server", "worker", "client", "admin",
                                                        "none"};
constexpr std::string_view kRolePrefix = "farpoint:role:";
constexpr std::string_view kTokenPrefix = "fp_";
constexpr size_t kTokenDigits = 64;
constexpr size_t kMaxNameBytes = 64;
constexpr size_t kMaxLines = 100'000;

bool IsAlnum(char c) { return std::isalnum(static_cast<unsigned char>(c)) != 0; }

// The next word of `line`, which is shortened.
std::string_view TakeWord(std::string_view& line) {
  const size_t begin = std::min(line.find_first_not_of(" \t\r"), line.size());
  line.remove_prefix(begin);
  const size_t end = std::min(line.find_first_of(" \t\r"), line.size());
  const std::string_view word = line.substr(0, end);
  line.remove_prefix(end);
  return word;
}

// Calls take(line, "FILE:N") for each line that is neither empty nor a comment.
template <typename Take>
absl::Status EachLine(std::string_view text, std::string_view file, const Take& take) {
  for (size_t number = 1; !text.empty(); ++number) {
    const std::string where = std::string(file) + ":" + std::to_string(number);
    if (number > kMaxLines) {
      return absl::InvalidArgumentError(where + ": more than " + std::to_string(kMaxLines) +
                                        " lines; remove what has expired");
    }
    const size_t end = text.find('\n');
    std::string_view line = text.substr(0, end);
    text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
    std::string_view rest = line;
    const std::string_view first = TakeWord(rest);
    if (first.empty() || first.front() == '#') continue;
    FP_RETURN_IF_ERROR(take(line, where));
  }
  return absl::OkStatus();
}

}  // namespace

std::string_view NameOf(Role role) { return kRoleNames[static_cast<size_t>(role)]; }

std::optional<Role> RoleFromName(std::string_view name) {
  for (const Role role : {Role::kServer, Role::kWorker, Role::kClient, Role::kAdmin}) {
    if (NameOf(role) == name) return role;
  }
  return std::nullopt;
}

std::string RoleUri(Role role) { return std::string(kRolePrefix) + std::string(NameOf(role)); }

std::optional<Role> RoleFromUri(std::string_view uri) {
  if (!uri.starts_with(kRolePrefix)) return std::nullopt;
  return RoleFromName(uri.substr(kRolePrefix.size()));
}

bool IsOpenMethod(std::string_view method) {
  return method.starts_with("/grpc.health.v1.Health/") || method.starts_with("/grpc.reflection.");
}

absl::Status CheckMayCall(const Caller& caller, std::string_view method) {
  if (IsOpenMethod(method)) return absl::OkStatus();
  const auto only = [&](std::string_view needed, bool allowed) -> absl::Status {
    if (allowed) return absl::OkStatus();
    return absl::PermissionDeniedError(
        "'" + caller.name + "' has the role " + std::string(NameOf(caller.role)) + ", but " +
        std::string(method) + " wants " + std::string(needed) +
        "; use a certificate or token of that role (farpoint certs add, farpoint certs token)");
  };
  const bool user = caller.role == Role::kClient || caller.role == Role::kAdmin;
  if (method == "/farpoint.v1.JobService/Diagnose") {
    return only("worker, client or admin", user || caller.role == Role::kWorker);
  }
  if (method.starts_with("/farpoint.v1.WorkerService/")) {
    return only("worker", caller.role == Role::kWorker);
  }
  if (method == "/farpoint.v1.BlobService/Put" ||
      method == "/farpoint.v1.BlobService/FindMissing") {
    return only("client or admin", user);
  }
  if (method.starts_with("/farpoint.v1.BlobService/")) {
    return only("worker", caller.role == Role::kWorker);
  }
  if (method.starts_with("/farpoint.v1.JobService/")) return only("client or admin", user);
  return only("worker, client or admin", user || caller.role == Role::kWorker);
}

absl::Status CheckName(std::string_view name) {
  const bool good = !name.empty() && name.size() <= kMaxNameBytes && IsAlnum(name.front()) &&
                    std::all_of(name.begin(), name.end(), [](char c) {
                      return IsAlnum(c) || c == '.' || c == '-' || c == '_' || c == '@';
                    });
  if (good) return absl::OkStatus();
  return absl::InvalidArgumentError(
      "'" + std::string(name.substr(0, 2 * kMaxNameBytes)) +
      "' is no name; take 1 to 64 letters, digits, '.', '-', '_' or '@', "
      "the first a letter or digit");
}

bool LooksLikeToken(std::string_view text) {
  if (!text.starts_with(kTokenPrefix) || text.size() != kTokenPrefix.size() + kTokenDigits)
    return false;
  text.remove_prefix(kTokenPrefix.size());
  return std::all_of(text.begin(), text.end(),
                     [](char c) { return std::isxdigit(static_cast<unsigned char>(c)) != 0; });
}

Digest TokenHash(std::string_view token) { return Sha256().Update(token).Finish(); }

absl::StatusOr<std::vector<TokenEntry>> ParseTokens(std::string_view text, std::string_view file) {
  std::vector<TokenEntry> entries;
  FP_RETURN_IF_ERROR(
      EachLine(text, file, [&](std::string_view line, const std::string& where) -> absl::Status {
        TokenEntry entry;
        const absl::StatusOr<Digest> hash = Digest::FromHex(TakeWord(line));
        const std::string_view name = TakeWord(line);
        const std::optional<Role> role = RoleFromName(TakeWord(line));
        const std::string_view expires = TakeWord(line);
        const char* const end = expires.data() + expires.size();
        const auto read = std::from_chars(expires.data(), end, entry.expires_unix_s);
        if (!hash.ok() || !CheckName(name).ok() ||
            (role != Role::kClient && role != Role::kAdmin) || read.ec != std::errc() ||
            read.ptr != end || !TakeWord(line).empty()) {
          return absl::InvalidArgumentError(
              where +
              ": expected 'sha256 name client|admin expires_unix_s'; remove the line and make "
              "the token again with farpoint certs token");
        }
        entry.hash = *hash;
        entry.name = std::string(name);
        entry.role = *role;
        entries.push_back(std::move(entry));
        return absl::OkStatus();
      }));
  return entries;
}

std::string FormatToken(const TokenEntry& entry) {
  return entry.hash.Hex() + " " + entry.name + " " + std::string(NameOf(entry.role)) + " " +
         std::to_string(entry.expires_unix_s) + "\n";
}

absl::StatusOr<std::vector<std::string>> ParseRevoked(std::string_view text,
                                                      std::string_view file) {
  std::vector<std::string> serials;
  FP_RETURN_IF_ERROR(
      EachLine(text, file, [&](std::string_view line, const std::string& where) -> absl::Status {
        std::string serial(TakeWord(line));
        const bool hex =
            serial.size() <= 64 && std::all_of(serial.begin(), serial.end(), [](char c) {
              return std::isxdigit(static_cast<unsigned char>(c)) != 0;
            });
        if (!hex) {
          return absl::InvalidArgumentError(where +
                                            ": expected a certificate's serial number in "
                                            "hexadecimal digits; correct or remove the line");
        }
        for (char& c : serial) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
        serials.push_back(std::move(serial));
        return absl::OkStatus();
      }));
  return serials;
}

HostPort SplitHostPort(std::string_view address) {
  const size_t colon = address.rfind(':');
  HostPort parts;
  parts.host = std::string(address.substr(0, colon));
  if (colon != std::string_view::npos) parts.port = std::string(address.substr(colon + 1));
  if (parts.host.size() > 2 && parts.host.front() == '[' && parts.host.back() == ']') {
    parts.host = parts.host.substr(1, parts.host.size() - 2);
  }
  return parts;
}

bool IsLoopback(std::string_view address) {
  const std::string host = SplitHostPort(address).host;
  if (host == "localhost" || host == "::1") return true;
  // Digits and dots only: 127.evil.example is somebody else's.
  return host.starts_with("127.") && std::count(host.begin(), host.end(), '.') == 3 &&
         host.find_first_not_of("0123456789.") == std::string::npos;
}

std::string UtcText(int64_t unix_s) {
  const std::time_t time = static_cast<std::time_t>(unix_s);
  std::tm parts{};
  if (::gmtime_r(&time, &parts) == nullptr) return std::to_string(unix_s);
  char text[40];
  std::snprintf(text, sizeof(text), "%04d-%02d-%02d %02d:%02d UTC", parts.tm_year + 1900,
                parts.tm_mon + 1, parts.tm_mday, parts.tm_hour, parts.tm_min);
  return text;
}

}  // namespace farpoint
