// Figures of a process in the text format that Prometheus reads (exposition format 0.0.4): families
// with `# HELP` and `# TYPE`, then their samples. Names end in their unit; what only grows ends in
// _total.
#pragma once

#include <array>
#include <cstdint>
#include <initializer_list>
#include <mutex>
#include <string>
#include <string_view>
#include <utility>

namespace farpoint {

inline constexpr char kMetricsContentType[] = "text/plain; version=0.0.4; charset=utf-8";

// How often something took how long. Thread-safe.
class DurationHistogram {
 public:
  // Upper bounds of the buckets in seconds; a last one has no bound.
  static constexpr std::array<double, 14> kBoundsS = {0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1,
                                                      2,     5,    10,   30,  60,  120, 600};
  // Negative and NaN count as 0.
  void Observe(double seconds);

  struct Snapshot {
    std::array<uint64_t, kBoundsS.size() + 1> buckets{};  // each for itself, not summed
    double sum_s = 0;
    uint64_t count = 0;
  };
  Snapshot Read() const;

 private:
  mutable std::mutex mutex_;
  Snapshot values_;  // guarded by mutex_
};

class MetricsText {
 public:
  using Labels = std::initializer_list<std::pair<std::string_view, std::string_view>>;

  // Starts a family; all of its samples follow before the next one starts. `type`: "counter",
  // "gauge" or "histogram".
  void Family(std::string_view name, std::string_view type, std::string_view help);
  void Sample(double value, Labels labels = {});
  // Of a family of type "histogram".
  void Histogram(const DurationHistogram::Snapshot& values);
  // A family of one sample without labels.
  void Single(std::string_view name, std::string_view type, std::string_view help, double value) {
    Family(name, type, help);
    Sample(value);
  }
  std::string Take() { return std::move(text_); }

 private:
  void Line(std::string_view suffix, double value, Labels labels);
  std::string text_, name_;
};

// process_*: processor time, memory, files, threads, start; and farpoint_build_info.
void AddProcessMetrics(MetricsText& text);

}  // namespace farpoint
