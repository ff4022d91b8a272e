#include "core/scene/text_lines.h"

#include <algorithm>
#include <charconv>
#include <limits>
#include <system_error>

namespace farpoint {

namespace {

bool IsBlank(char c) { return c == ' ' || c == '\t' || c == '\v' || c == '\f'; }

std::string_view WithoutPlus(std::string_view word) {
  if (word.size() > 1 && word[0] == '+' && word[1] != '-' && word[1] != '+') word.remove_prefix(1);
  return word;
}

}  // namespace

bool LineReader::NextRaw(std::string_view& line) {
  if (at_ >= text_.size()) return false;
  const size_t end = std::min(text_.find_first_of("\r\n", at_), text_.size());
  line = text_.substr(at_, end - at_);
  const bool two = end + 1 < text_.size() && text_[end] == '\r' && text_[end + 1] == '\n';
  at_ = end + (two ? 2 : 1);
  ++raw_number_;
  return true;
}

bool LineReader::Next(std::string_view& line) {
  std::string_view raw;
  if (!NextRaw(raw)) return false;
  number_ = raw_number_;
  line = Trim(raw);
  if (line.empty() || line.back() != '\\') return true;
  joined_.assign(line.substr(0, line.size() - 1));
  while (NextRaw(raw)) {
    raw = Trim(raw);
    const bool more = !raw.empty() && raw.back() == '\\';
    joined_ += ' ';
    joined_ += more ? raw.substr(0, raw.size() - 1) : raw;
    if (!more) break;
  }
  line = Trim(joined_);
  return true;
}

std::string_view Trim(std::string_view text) {
  while (!text.empty() && IsBlank(text.front())) text.remove_prefix(1);
  while (!text.empty() && IsBlank(text.back())) text.remove_suffix(1);
  return text;
}

std::string_view NextWord(std::string_view& rest) {
  size_t begin = 0;
  while (begin < rest.size() && IsBlank(rest[begin])) ++begin;
  size_t end = begin;
  while (end < rest.size() && !IsBlank(rest[end])) ++end;
  const std::string_view word = rest.substr(begin, end - begin);
  rest.remove_prefix(end);
  return word;
}

std::optional<double> ParseNumber(std::string_view word) {
  word = WithoutPlus(word);
  double value = 0;
  const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
  if (end != word.data() + word.size() || word.empty()) return std::nullopt;
  if (error == std::errc::result_out_of_range) {
    // from_chars does not say which end of the range was passed.
    const size_t exponent = word.find_first_of("eE");
    const bool tiny = exponent != std::string_view::npos && exponent + 1 < word.size() &&
                      word[exponent + 1] == '-';
    if (tiny) return 0.0;
    return word[0] == '-' ? -std::numeric_limits<double>::infinity()
                          : std::numeric_limits<double>::infinity();
  }
  if (error != std::errc()) return std::nullopt;
  return value;
}

std::optional<int64_t> ParseInteger(std::string_view word) {
  word = WithoutPlus(word);
  int64_t value = 0;
  const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
  if (error != std::errc() || end != word.data() + word.size()) return std::nullopt;
  return value;
}

std::string Quoted(std::string_view text) {
  constexpr size_t kLongest = 40;
  std::string quoted = "'";
  for (const char c : text.substr(0, kLongest)) {
    const auto byte = static_cast<unsigned char>(c);
    quoted += byte < 32 || byte == 127 ? '?' : c;
  }
  return quoted + (text.size() > kLongest ? "…'" : "'");
}

}  // namespace farpoint
