// What a Pareto run found, written for programs and for people. docs/benchmarks.md explains it.
#pragma once

#include <string>

#include "bench/pareto.h"

namespace farpoint {

// One JSON object, two spaces to a level, UTF-8. Numbers that do not exist are null.
std::string ParetoJson(const ParetoReport& report);

// A self-contained page: the plot as inline SVG and the tables. Loads nothing, runs nothing.
std::string ParetoHtml(const ParetoReport& report);

// For a terminal; the fastest first within each integrator.
std::string ParetoTable(const ParetoReport& report);

}  // namespace farpoint
