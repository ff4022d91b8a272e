# cmake -DFOLDER=… -DOUT=… -P EmbedWebFiles.cmake: a .cc file that holds the files of server/web.
set(entries "")
foreach(file IN ITEMS "index.html|/|text/html" "app.js|/app.js|text/javascript"
                      "style.css|/style.css|text/css")
  string(REPLACE "|" ";" parts "${file}")
  list(GET parts 0 name)
  list(GET parts 1 path)
  list(GET parts 2 type)
  file(READ "${FOLDER}/${name}" text)
  string(APPEND entries "    {\"${path}\", \"${type}; charset=utf-8\", R\"web(${text})web\"},\n")
endforeach()
file(WRITE "${OUT}" "#include \"server/web_files.h\"\n\nnamespace farpoint {\n\n"
  "const WebFile kWebFiles[3] = {\n${entries}};\n\n}  // namespace farpoint\n")
