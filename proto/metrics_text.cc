#include "proto/metrics_text.h"

#include <unistd.h>

#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>

#include "core/base/clock.h"
#include "core/base/machine.h"

namespace farpoint {

namespace {

std::string Number(double value) {
  if (std::isnan(value)) return "NaN";
  if (std::isinf(value)) return value > 0 ? "+Inf" : "-Inf";
  char text[64];
  const auto end = std::to_chars(text, text + sizeof(text), value);
  return std::string(text, end.ptr);
}

// Backslash and line feed everywhere, the quote in labels only.
std::string Escaped(std::string_view text, bool label) {
  std::string out;
  for (const char c : text) {
    if (c == '\\') {
      out += "\\\\";
    } else if (c == '\n') {
      out += "\\n";
    } else if (c == '"' && label) {
      out += "\\\"";
    } else {
      out += c;
    }
  }
  return out;
}

std::string ReadProc(const char* path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
}

// "Name:   123 kB" or "Name:   5"; 0 if it is not there.
double FieldOf(const std::string& text, const char* name) {
  const size_t at = text.find(name);
  return at == std::string::npos ? 0 : std::strtod(text.c_str() + at + std::strlen(name), nullptr);
}

// Seconds of the Unix clock; 0 if it is not known.
double StartTimeS() {
  // The 22nd field; the second one, a name in parentheses, may hold anything.
  const std::string stat = ReadProc("/proc/self/stat");
  size_t at = stat.rfind(')');
  for (int field = 2; field < 22 && at != std::string::npos; ++field) at = stat.find(' ', at + 1);
  const double boot = FieldOf(ReadProc("/proc/stat"), "btime ");
  if (at == std::string::npos || boot == 0) return 0;
  return boot +
         std::strtod(stat.c_str() + at, nullptr) / static_cast<double>(::sysconf(_SC_CLK_TCK));
}

}  // namespace

void DurationHistogram::Observe(double seconds) {
  if (!(seconds > 0)) seconds = 0;
  size_t bucket = 0;
  while (bucket < kBoundsS.size() && seconds > kBoundsS[bucket]) ++bucket;
  std::lock_guard lock(mutex_);
  ++values_.buckets[bucket];
  ++values_.count;
  values_.sum_s += seconds;
}

DurationHistogram::Snapshot DurationHistogram::Read() const {
  std::lock_guard lock(mutex_);
  return values_;
}

void MetricsText::Family(std::string_view name, std::string_view type, std::string_view help) {
  name_ = name;
  text_ += "# HELP " + name_ + " " + Escaped(help, false) + "\n# TYPE " + name_ + " ";
  text_.append(type).append("\n");
}

void MetricsText::Line(std::string_view suffix, double value, Labels labels) {
  text_.append(name_).append(suffix);
  if (labels.size() > 0) {
    char separator = '{';
    for (const auto& [name, label] : labels) {
      text_ += separator;
      text_.append(name).append("=\"").append(Escaped(label, true)).append("\"");
      separator = ',';
    }
    text_ += '}';
  }
  text_ += " " + Number(value) + "\n";
}

void MetricsText::Sample(double value, Labels labels) { Line("", value, labels); }

void MetricsText::Histogram(const DurationHistogram::Snapshot& values) {
  uint64_t below = 0;
  for (size_t i = 0; i < values.buckets.size(); ++i) {
    below += values.buckets[i];
    const bool last = i == DurationHistogram::kBoundsS.size();
    Line("_bucket", static_cast<double>(below),
         {{"le", last ? "+Inf" : Number(DurationHistogram::kBoundsS[i])}});
  }
  Line("_sum", values.sum_s, {});
  Line("_count", static_cast<double>(values.count), {});
}

void AddProcessMetrics(MetricsText& text) {
  const std::string status = ReadProc("/proc/self/status");
  const OpenFileFacts files = ReadOpenFileFacts();
  text.Family("farpoint_build_info", "gauge", "1, with the version as a label.");
  text.Sample(1, {{"version", FARPOINT_VERSION}});
  text.Single("process_cpu_seconds_total", "counter", "Processor time of all threads.",
              ProcessCpuSeconds());
  text.Single("process_resident_memory_bytes", "gauge", "Memory that is resident.",
              1024 * FieldOf(status, "VmRSS:"));
  text.Single("process_virtual_memory_bytes", "gauge", "Address space that is in use.",
              1024 * FieldOf(status, "VmSize:"));
  text.Single("process_threads", "gauge", "Threads.", FieldOf(status, "Threads:"));
  text.Single("process_open_fds", "gauge", "Open files.", static_cast<double>(files.open));
  text.Single("process_max_fds", "gauge", "Most open files.", static_cast<double>(files.limit));
  text.Single("process_start_time_seconds", "gauge", "When the process started, Unix time.",
              StartTimeS());
}

}  // namespace farpoint
