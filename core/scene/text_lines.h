// Lines, words and numbers of the text formats (OBJ, MTL, PLY). Views into the text; no locale.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>

namespace farpoint {

// Walks the lines of a text, which must outlive it. Ends of lines are \n, \r\n or \r; a backslash
// at the end of a line joins the next one to it (OBJ, MTL).
class LineReader {
 public:
  explicit LineReader(std::string_view text) : text_(text) {}

  // The next line without its end, trimmed; false at the end of the text. The view is valid until
  // the next call.
  bool Next(std::string_view& line);
  // Of the line that Next gave, from 1; of its first part where lines were joined.
  size_t number() const { return number_; }

 private:
  bool NextRaw(std::string_view& line);

  std::string_view text_;
  size_t at_ = 0, raw_number_ = 0, number_ = 0;
  std::string joined_;
};

// Without blanks and tabs at both ends.
std::string_view Trim(std::string_view text);

// Cuts the first word off `rest`; empty if there is none.
std::string_view NextWord(std::string_view& rest);

// The whole word as a decimal number, with or without a sign; infinite beyond the range of double
// and for "inf", NaN for "nan". Nothing if it is no number.
std::optional<double> ParseNumber(std::string_view word);

// The whole word as an integer, with or without a sign. Nothing if it is none or beyond 64 bits.
std::optional<int64_t> ParseInteger(std::string_view word);

// `text` as valid UTF-8 without control characters: each byte that is part of neither is a '?'.
// Names of files in older encodings stay recognisable, and messages can travel.
std::string Printable(std::string_view text);

// For messages: the beginning of `text`, at most 40 bytes, printable and quoted.
std::string Quoted(std::string_view text);

}  // namespace farpoint
