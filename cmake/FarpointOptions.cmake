# Compiler settings shared by every target of the project.
#
# Determinism (docs/decisions/0001-determinism.md) rests on three of them:
#   -march=x86-64-v3      one instruction set for every machine; no dispatch decides a pixel
#   -ffp-contract=off     a multiply-add is fused only where the code says std::fma
#   no -ffast-math        -fno-math-errno and -fno-trapping-math change no value
# Debug builds and those of GCC with the address sanitizer trap floating-point exceptions
# (core/base/fp_trap.h), so they do without the last: it lets the compiler speculate divisions.
if(FARPOINT_SANITIZE MATCHES address AND CMAKE_CXX_COMPILER_ID STREQUAL GNU)
  set(traps 1)
else()
  set(traps $<CONFIG:Debug>)
endif()
add_library(farpoint_options INTERFACE)
target_compile_options(farpoint_options INTERFACE
  -march=x86-64-v3 -ffp-contract=off -fno-math-errno
  $<$<NOT:${traps}>:-fno-trapping-math>
  -Wall -Wextra -Wno-unused-parameter -Wno-missing-field-initializers -Wno-restrict)
target_include_directories(farpoint_options INTERFACE ${PROJECT_SOURCE_DIR})
target_compile_definitions(farpoint_options INTERFACE FARPOINT_VERSION="${PROJECT_VERSION}"
  $<${traps}:FARPOINT_TRAP_FP>)
if(FARPOINT_SANITIZE)
  target_compile_options(farpoint_options INTERFACE
    -fsanitize=${FARPOINT_SANITIZE} -fno-omit-frame-pointer -fno-sanitize-recover=all)
  target_link_options(farpoint_options INTERFACE -fsanitize=${FARPOINT_SANITIZE})
endif()

find_program(FARPOINT_CCACHE ccache)
if(FARPOINT_CCACHE)
  set(CMAKE_C_COMPILER_LAUNCHER ${FARPOINT_CCACHE})
  set(CMAKE_CXX_COMPILER_LAUNCHER ${FARPOINT_CCACHE})
endif()
find_program(FARPOINT_MOLD mold)
if(FARPOINT_MOLD)
  add_link_options(-fuse-ld=mold)
endif()

# farpoint_library(NAME SOURCES … PUBLIC … PRIVATE …): a static library of one folder.
# Third-party packages belong to PRIVATE, so that their headers stay behind one file.
function(farpoint_library NAME)
  cmake_parse_arguments(ARG "" "" "SOURCES;PUBLIC;PRIVATE" ${ARGN})
  add_library(${NAME} STATIC ${ARG_SOURCES})
  target_link_libraries(${NAME} PUBLIC farpoint_options ${ARG_PUBLIC} PRIVATE ${ARG_PRIVATE})
endfunction()

# farpoint_test(NAME SOURCES … LIBS …): one test binary, its cases found by CTest.
function(farpoint_test NAME)
  cmake_parse_arguments(ARG "" "TIMEOUT" "SOURCES;LIBS" ${ARGN})
  if(NOT ARG_TIMEOUT)
    set(ARG_TIMEOUT 300)
  endif()
  add_executable(${NAME} ${ARG_SOURCES})
  target_link_libraries(${NAME} PRIVATE ${ARG_LIBS} GTest::gtest GTest::gmock GTest::gtest_main)
  set_target_properties(${NAME} PROPERTIES RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/tests)
  gtest_discover_tests(${NAME} TEST_PREFIX "${NAME}." DISCOVERY_TIMEOUT 60
    PROPERTIES TIMEOUT ${ARG_TIMEOUT})
endfunction()
