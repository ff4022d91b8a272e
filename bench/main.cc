#include <exception>
#include <iostream>
#include <new>

#include "bench/program.h"

int main(int argc, char** argv) {
  try {
    const int code =
        farpoint::RunBench({argv + (argc > 0 ? 1 : 0), argv + argc}, std::cout, std::cerr);
    return code == 0 && !std::cout ? 75 : code;
  } catch (const std::bad_alloc&) {
    std::cerr << "farpoint-bench: not enough memory; use fewer pixels or points\n";
    return 75;
  } catch (const std::exception& error) {
    std::cerr << "farpoint-bench: unexpected failure: " << error.what() << "\n";
    return 42;
  }
}
