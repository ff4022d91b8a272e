"""tools/check_includes on trees with one violation each."""

import subprocess
import unittest

from tool_test import TreeTest

HEADER = "// A header.\n#pragma once\n"

# A tree in which every arrow points the way that it may.
CLEAN = {
    "core/base/hash.h": HEADER + "#include <string>\n",
    "core/base/hash.cc": '#include "core/base/hash.h"\n#include <openssl/evp.h>\n',
    "core/math/vec.h": HEADER + '#include "core/base/hash.h"\n',
    "core/scene/scene.h": HEADER + '#include "core/math/vec.h"\n',
    "core/scene/gltf.cc": '#include <tiny_gltf.h>\n#include "core/scene/scene.h"\n',
    "core/accel/ray.h": HEADER + '#include "core/scene/scene.h"\n',
    "core/accel/ray.cc": '#include <embree3/rtcore.h>\n#include "core/accel/ray.h"\n',
    "core/image/exr_io.cc": "#include <OpenEXR/ImfOutputFile.h>\n",
    "core/light/light.h": HEADER + '#include "core/accel/ray.h"\n',
    "core/pbgi/tree.h": HEADER + '#include "core/light/light.h"\n',
    "core/render/tile.h": HEADER + '#include "core/pbgi/tree.h"\n',
    "proto/convert.h": HEADER + '#include "core/render/tile.h"\n#include "proto/job.pb.h"\n',
    "server/service.cc": '#include <grpcpp/grpcpp.h>\n#include "proto/convert.h"\n',
    "server/server.h": HEADER,
    "worker/worker.h": HEADER + '#include "absl/status/status.h"\n',
    "client/embedded.cc": '#include "server/server.h"\n#include "worker/worker.h"\n',
    "tests/unit/hash_test.cc": '#include <gtest/gtest.h>\n#include "core/base/hash.h"\n',
    "bench/hash_bench.cc": '#include "core/base/hash.h"\n#include <sys/stat.h>\n',
}


class CheckIncludes(TreeTest):
    def violations(self, changes):
        code, lines = self.check("check_includes", {**CLEAN, **changes})
        self.assertEqual(1 if len(lines) > 1 else 0, code, lines)
        return lines[:-1]

    def assert_reports(self, path, text, line, *words):
        lines = self.violations({path: text})
        self.assertEqual(1, len(lines), lines)
        self.assertTrue(lines[0].startswith(f"{path}:{line}: "), lines[0])
        for word in words:
            self.assertIn(word, lines[0])

    def test_a_clean_tree_passes(self):
        code, lines = self.check("check_includes", CLEAN)
        self.assertEqual((0, [f"check_includes: {len(CLEAN)} files, no violation"]),
                         (code, lines))

    def test_every_arrow_against_the_layers_is_reported(self):
        upward = [("core/base/x.cc", "core/math/vec.h"),
                  ("core/math/x.cc", "core/scene/scene.h"),
                  ("core/scene/x.cc", "core/accel/ray.h"),
                  ("core/image/x.cc", "core/scene/scene.h"),
                  ("core/accel/x.cc", "core/light/light.h"),
                  ("core/light/x.cc", "core/pbgi/tree.h"),
                  ("core/pbgi/x.cc", "core/render/tile.h"),
                  ("core/render/x.cc", "proto/convert.h"),
                  ("proto/x.cc", "server/server.h"),
                  ("server/x.cc", "worker/worker.h"),
                  ("worker/x.cc", "server/server.h")]
        for path, target in upward:
            with self.subTest(path=path):
                self.assert_reports(path, f'// What.\n#include "{target}"\n', 2, target)
                self.write(path, "")

    def test_nothing_includes_the_client_the_tests_or_the_benchmarks(self):
        for folder in ("client", "tests", "bench"):
            target = f"{folder}/helper.h"
            self.write(target, HEADER)
            with self.subTest(folder=folder):
                self.assert_reports("server/x.cc", f'#include "{target}"\n', 1, target)

    def test_a_benchmark_must_not_include_a_test(self):
        self.write("tests/helper.h", HEADER)
        self.assert_reports("bench/x.cc", '#include "tests/helper.h"\n', 1, "tests/helper.h")

    def test_third_party_headers_stay_behind_their_files(self):
        strays = [("core/render/x.cc", "embree3/rtcore.h", "Embree"),
                  ("core/accel/x.h", "embree3/rtcore.h", "Embree"),
                  ("core/image/film.cc", "OpenEXR/ImfOutputFile.h", "OpenEXR"),
                  ("core/image/film.cc", "Imath/ImathBox.h", "OpenEXR"),
                  ("core/image/x.cc", "tiny_gltf.h", "tinygltf"),
                  ("core/render/x.cc", "stb/stb_image.h", "stb"),
                  ("core/base/x.cc", "grpcpp/grpcpp.h", "gRPC"),
                  ("core/render/x.cc", "google/protobuf/message.h", "protobuf"),
                  ("core/render/x.cc", "spdlog/spdlog.h", "spdlog"),
                  ("proto/x.cc", "spdlog/spdlog.h", "spdlog"),
                  ("core/render/x.cc", "CLI/CLI.hpp", "CLI11"),
                  ("core/math/x.cc", "tbb/parallel_for.h", "oneTBB"),
                  ("core/base/blob.cc", "openssl/evp.h", "OpenSSL"),
                  ("worker/x.cc", "sqlite3.h", "SQLite"),
                  ("server/x.cc", "gtest/gtest.h", "GoogleTest")]
        for path, header, library in strays:
            text = f"#pragma once\n#include <{header}>\n"
            with self.subTest(path=path, header=header):
                self.assert_reports(path, text, 2, header, library)
                self.write(path, "#pragma once\n")

    def test_quotes_do_not_hide_a_third_party_header(self):
        self.assert_reports("core/render/x.cc", '#include "embree3/rtcore.h"\n', 1, "Embree")

    def test_a_generated_header_belongs_to_the_wire_layer(self):
        lines = self.violations({"core/render/x.cc": '#include "proto/job.pb.h"\n'})
        self.assertEqual(2, len(lines), lines)
        self.assertIn("protobuf", lines[0])
        self.assertIn("core/render may not include proto", lines[1])

    def test_an_unknown_library_is_reported(self):
        self.assert_reports("core/base/x.cc", "#include <boost/any.hpp>\n", 1, "boost/any.hpp",
                            "THIRD_PARTY")

    def test_relative_paths_are_reported_with_the_right_one(self):
        for name in ("hash.h", "../base/hash.h", "./hash.h"):
            with self.subTest(name=name):
                self.assert_reports("core/base/x.cc", f'\n\n#include "{name}"\n', 3,
                                    '"core/base/hash.h"')

    def test_a_project_header_in_angles_is_reported(self):
        self.assert_reports("core/math/x.cc", "#include <core/base/hash.h>\n", 1, "write")

    def test_a_missing_file_is_reported(self):
        self.assert_reports("core/math/x.cc", '#include "core/base/gone.h"\n', 1, "gone.h")

    def test_a_source_file_is_no_header(self):
        self.assert_reports("core/base/x.cc", '#include "core/base/hash.cc"\n', 1, "hash.cc")

    def test_a_header_without_pragma_once_is_reported(self):
        self.assert_reports("core/base/x.h", "// #pragma once\n", 1, "#pragma once")

    def test_a_folder_without_a_layer_is_reported(self):
        self.assert_reports("extra/x.cc", '#include "core/base/hash.h"\n', 1, "extra/x.cc")

    def test_an_include_in_a_comment_is_none(self):
        self.assertEqual([], self.violations({
            "core/base/x.cc": '/* one\n#include "server/server.h"\n*/ // #include "gone.h"\n'
                              'const char* s = "/*";\n'}))
        # The quoted opening of a comment above must not swallow what follows.
        self.assert_reports("core/base/x.cc",
                            'const char* s = "/*";\n#include "server/server.h"\n', 2, "server")

    def test_a_file_that_git_ignores_is_not_checked(self):
        subprocess.run(["git", "init", "-q", self.root], check=True)
        self.assertEqual([], self.violations({
            ".gitignore": "/generated/\n", "generated/x.cc": '#include "gone.h"\n'}))


if __name__ == "__main__":
    unittest.main()
