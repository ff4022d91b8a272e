// "Did you mean …": the known name that a mistyped one is nearest to.
#pragma once

#include <span>
#include <string>
#include <string_view>

namespace farpoint {

// Least number of inserted, removed, replaced or swapped neighbouring characters.
int EditDistance(std::string_view a, std::string_view b);

// The nearest of `known`, the earlier one of equals; empty if none is within about a third of the
// name's length (so that "--foo" suggests nothing rather than something silly).
std::string NearestName(std::string_view name, std::span<const std::string> known);

}  // namespace farpoint
