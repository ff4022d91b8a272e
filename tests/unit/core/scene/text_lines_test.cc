#include "core/scene/text_lines.h"

#include <gtest/gtest.h>

#include <cmath>
#include <utility>
#include <vector>

namespace farpoint {
namespace {

std::vector<std::pair<size_t, std::string>> LinesOf(std::string_view text) {
  LineReader reader(text);
  std::vector<std::pair<size_t, std::string>> lines;
  std::string_view line;
  while (reader.Next(line)) lines.emplace_back(reader.number(), line);
  return lines;
}

TEST(LineReader, NumbersLinesOfEveryEnding) {
  using Lines = std::vector<std::pair<size_t, std::string>>;
  EXPECT_EQ(LinesOf("a\r\n\n b \rc"), (Lines{{1, "a"}, {2, ""}, {3, "b"}, {4, "c"}}));
  EXPECT_EQ(LinesOf(""), Lines{});
  EXPECT_EQ(LinesOf("\n"), (Lines{{1, ""}}));
}

TEST(LineReader, JoinsContinuedLinesUnderTheNumberOfTheFirst) {
  using Lines = std::vector<std::pair<size_t, std::string>>;
  EXPECT_EQ(LinesOf("f 1 \\\n2 \\\r\n 3\nv\n"), (Lines{{1, "f 1  2  3"}, {4, "v"}}));
  EXPECT_EQ(LinesOf("end\\"), (Lines{{1, "end"}}));
}

TEST(ParseNumber, TakesWholeWordsOnly) {
  EXPECT_EQ(ParseNumber("+.5e1"), 5.0);
  EXPECT_EQ(ParseNumber("-2."), -2.0);
  EXPECT_EQ(ParseNumber("1e-999"), 0.0);
  EXPECT_TRUE(std::isinf(*ParseNumber("1e999")));
  EXPECT_LT(*ParseNumber("-1e999"), 0);
  EXPECT_TRUE(std::isnan(*ParseNumber("nan")));
  for (const char* word : {"", "+", "-", "1x", "0x10", "1,5", "--1", "+-1", "3.1+e2"}) {
    EXPECT_FALSE(ParseNumber(word)) << word;
  }
}

TEST(ParseInteger, RefusesWhatDoesNotFit) {
  EXPECT_EQ(ParseInteger("-12"), -12);
  EXPECT_EQ(ParseInteger("+7"), 7);
  EXPECT_FALSE(ParseInteger("9223372036854775808"));
  EXPECT_FALSE(ParseInteger("1.0"));
  EXPECT_FALSE(ParseInteger(""));
}

TEST(Printable, KeepsUtf8AndReplacesTheRest) {
  EXPECT_EQ(Printable("W\xc3\xa4nde \xe2\x82\xac \xf0\x9f\x98\x80"),
            "W\xc3\xa4nde \xe2\x82\xac \xf0\x9f\x98\x80");
  EXPECT_EQ(Printable("W\xe4nde"), "W?nde");  // Latin-1
  EXPECT_EQ(Printable("\xc0\x80"),
            "?"
            "?");  // too long a form
  EXPECT_EQ(Printable("\xed\xa0\x80"),
            "?"
            "?"
            "?");                                       // a surrogate
  EXPECT_EQ(Printable("\xf4\x90\x80\x80").size(), 4u);  // beyond U+10FFFF
  EXPECT_EQ(Printable("a\xe2\x82"),
            "a?"
            "?");  // cut off
  EXPECT_EQ(Printable("a\x01\n\x7f"),
            "a?"
            "?"
            "?");
}

TEST(Quoted, ShortensBetweenCharacters) {
  EXPECT_EQ(Quoted("abc"), "'abc'");
  EXPECT_EQ(Quoted(std::string(100, 'x')), "'" + std::string(40, 'x') + "…'");
  EXPECT_EQ(Quoted(std::string(39, 'x') + "\xc3\xa4y"), "'" + std::string(39, 'x') + "…'");
}

}  // namespace
}  // namespace farpoint
