#include "core/base/nearest_name.h"

#include <algorithm>
#include <vector>

namespace farpoint {

int EditDistance(std::string_view a, std::string_view b) {
  // Optimal string alignment, three rows at a time.
  std::vector<int> before(b.size() + 1), last(b.size() + 1), row(b.size() + 1);
  for (size_t j = 0; j <= b.size(); ++j) last[j] = static_cast<int>(j);
  for (size_t i = 1; i <= a.size(); ++i) {
    row[0] = static_cast<int>(i);
    for (size_t j = 1; j <= b.size(); ++j) {
      const int replace = last[j - 1] + (a[i - 1] == b[j - 1] ? 0 : 1);
      row[j] = std::min({replace, last[j] + 1, row[j - 1] + 1});
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1]) {
        row[j] = std::min(row[j], before[j - 2] + 1);
      }
    }
    before.swap(last);
    last.swap(row);
  }
  return last[b.size()];
}

std::string NearestName(std::string_view name, std::span<const std::string> known) {
  const int reach = static_cast<int>(name.size()) / 3 + 1;
  const std::string* nearest = nullptr;
  int nearest_distance = reach + 1;
  for (const std::string& candidate : known) {
    int distance = EditDistance(name, candidate);
    // An abbreviation is nearer than its length says: "--res" means "--resolution".
    if (name.size() >= 3 && candidate.starts_with(name)) distance = std::min(distance, 1);
    if (distance < nearest_distance) {
      nearest = &candidate;
      nearest_distance = distance;
    }
  }
  return nearest == nullptr ? std::string() : *nearest;
}

}  // namespace farpoint
