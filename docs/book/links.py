"""A preprocessor of mdBook: links of included files become links inside the book, those to other files plain text."""

import json
import os
import posixpath
import re
import sys

# Files outside docs that the book includes, and their chapters.
INSIDE = {
    "README.md": "book/what-it-is.md",
    "ARCHITECTURE.md": "book/architecture.md",
    "CONTRIBUTING.md": "book/contributing.md",
    "docs/README.md": "index.md",
}
INCLUDE = re.compile(r"\{\{#include ([^}:]+)[^}]*\}\}")
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")


def included(text, folder):
    """The text with the files that it includes, their links relative to the chapter."""

    def of_file(match):
        path = posixpath.normpath(posixpath.join(folder, match[1].strip()))
        with open(path, encoding="utf-8") as file:
            return links(file.read(), posixpath.dirname(path), folder)

    return INCLUDE.sub(of_file, text)


def links(text, at, folder):
    """Links of a text of the folder `at`, for a chapter in `folder`; paths are relative to the repository."""

    def of_link(match):
        mark, words, target = match.groups()
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        file, hash_, part = target.partition("#")
        path = posixpath.normpath(posixpath.join(at, file))
        path = posixpath.join("docs", INSIDE[path]) if path in INSIDE else path
        if not path.startswith("docs/"):
            return words
        return f"{mark}[{words}]({posixpath.relpath(path, folder)}{hash_}{part})"

    return LINK.sub(of_link, text)


def chapters(items):
    for item in items:
        if "Chapter" in item:
            yield item["Chapter"]
            yield from chapters(item["Chapter"]["sub_items"])


def main():
    if sys.argv[1:2] == ["supports"]:
        return
    context, book = json.load(sys.stdin)
    os.chdir(posixpath.join(context["root"], "../.."))
    for chapter in chapters(book.get("items") or book.get("sections")):
        if chapter["path"]:
            folder = posixpath.dirname(posixpath.join("docs", chapter["path"]))
            chapter["content"] = links(included(chapter["content"], folder), folder, folder)
    json.dump(book, sys.stdout)


if __name__ == "__main__":
    main()
