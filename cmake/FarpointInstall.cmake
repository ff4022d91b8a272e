# cmake --install BUILD [--prefix DIR] [--strip] [--component NAME]
#
# Components: client, coordinator, worker, health (a program each), bench (not installed unless
# asked for), doc (licence, documentation, scenes, wire format, Slurm's scripts, systemd's units,
# manual pages, shell completion). docs/deploy.md lists what goes where.
include(GNUInstallDirs)

install(FILES LICENSE README.md CONTRIBUTING.md DESTINATION ${CMAKE_INSTALL_DOCDIR} COMPONENT doc)
install(DIRECTORY docs docker scenes DESTINATION ${CMAKE_INSTALL_DOCDIR}
  USE_SOURCE_PERMISSIONS COMPONENT doc)
install(TARGETS farpoint-bench RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR}
  COMPONENT bench EXCLUDE_FROM_ALL)

if(FARPOINT_SERVICE)
  foreach(pair IN ITEMS client:farpoint coordinator:farpoint-server worker:farpoint-worker
                        health:farpoint-health)
    string(REPLACE ":" ";" pair ${pair})
    list(GET pair 0 component)
    list(GET pair 1 program)
    install(TARGETS ${program} RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR} COMPONENT ${component})
  endforeach()
  install(FILES proto/farpoint.proto DESTINATION ${CMAKE_INSTALL_DATADIR}/farpoint/proto
    COMPONENT doc)
  install(PROGRAMS docker/slurm/coordinator.sbatch docker/slurm/workers.sbatch
    DESTINATION ${CMAKE_INSTALL_DATADIR}/farpoint/slurm COMPONENT doc)
  install(FILES docker/systemd/farpoint-server.service docker/systemd/farpoint-worker.service
    DESTINATION ${CMAKE_INSTALL_DATADIR}/farpoint/systemd COMPONENT doc)
endif()

# Manual pages and completion are what the programs say of themselves (tools/make_manual).
# Sanitized programs are for tests.
if(FARPOINT_SERVICE AND NOT FARPOINT_SANITIZE)
  find_package(Python3 COMPONENTS Interpreter REQUIRED)
  set(manual ${PROJECT_BINARY_DIR}/manual)
  add_custom_command(OUTPUT ${manual}/made
    COMMAND ${CMAKE_COMMAND} -E rm -rf ${manual}
    COMMAND Python3::Interpreter -B ${PROJECT_SOURCE_DIR}/tools/make_manual
      --bin ${CMAKE_RUNTIME_OUTPUT_DIRECTORY} --out ${manual} --version ${PROJECT_VERSION}
    COMMAND ${CMAKE_COMMAND} -E touch ${manual}/made
    DEPENDS farpoint farpoint-server farpoint-worker farpoint-health
      ${PROJECT_SOURCE_DIR}/tools/make_manual
    COMMENT "Manual pages and shell completion"
    VERBATIM)
  add_custom_target(farpoint-manual ALL DEPENDS ${manual}/made)
  install(DIRECTORY ${manual}/man1 DESTINATION ${CMAKE_INSTALL_MANDIR} COMPONENT doc)
  install(DIRECTORY ${manual}/bash/ COMPONENT doc
    DESTINATION ${CMAKE_INSTALL_DATADIR}/bash-completion/completions)
  install(DIRECTORY ${manual}/zsh/ COMPONENT doc
    DESTINATION ${CMAKE_INSTALL_DATADIR}/zsh/site-functions)
endif()
