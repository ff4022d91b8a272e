# cmake --install BUILD [--prefix DIR] [--strip] [--component NAME]
#
# Components: client, coordinator, worker, health (a program each), bench (not installed unless
# asked for), doc (licence, documentation, wire format, manual pages, shell completion).
include(GNUInstallDirs)

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
endif()
install(TARGETS farpoint-bench RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR}
  COMPONENT bench EXCLUDE_FROM_ALL)

install(FILES LICENSE README.md DESTINATION ${CMAKE_INSTALL_DOCDIR} COMPONENT doc)
install(DIRECTORY docs scenes DESTINATION ${CMAKE_INSTALL_DOCDIR} COMPONENT doc)
