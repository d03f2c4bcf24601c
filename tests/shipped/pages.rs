//! The documentation as one net: every link between pages leads to a file, every page is a chapter of the book.

use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn pages_in(folder: &str) -> Vec<PathBuf> {
    let entries =
        std::fs::read_dir(root().join(folder)).expect(folder).map(|entry| entry.expect("an entry").path());
    entries.filter(|path| path.extension().is_some_and(|end| end == "md")).collect()
}

/// Targets of the links in a page, without those of other sites and of the page itself.
fn links(text: &str) -> impl Iterator<Item = &str> {
    let targets =
        text.match_indices("](").filter_map(|(at, _)| text[at + 2..].split_once(')')).map(|(to, _)| to);
    targets.filter(|to| !to.contains("://") && !to.starts_with('#') && !to.contains(' ') && !to.is_empty())
}

#[test]
fn every_link_leads_to_a_file() {
    let pages: Vec<PathBuf> = ["", "docs", "docs/book"].into_iter().flat_map(pages_in).collect();
    assert!(pages.len() > 25, "{pages:?}");
    let mut broken = Vec::new();
    for page in &pages {
        let text = std::fs::read_to_string(page).expect("a page");
        let file = |to: &str| to.split('#').next().map(|file| page.with_file_name(file));
        let lost = links(&text).filter(|to| file(to).is_none_or(|file| !file.exists()));
        broken.extend(lost.map(|to| format!("{}: {to}", page.display())));
    }
    assert!(broken.is_empty(), "{broken:#?}");
}

#[test]
fn every_page_is_a_chapter() {
    let summary = std::fs::read_to_string(root().join("docs/SUMMARY.md")).expect("the summary");
    for page in pages_in("docs").iter().chain(&pages_in("docs/book")) {
        let name = page.strip_prefix(root().join("docs")).expect("below docs").display().to_string();
        let is_index = ["README.md", "SUMMARY.md"].contains(&name.as_str());
        assert!(is_index || summary.contains(&format!("({name})")), "{name} is not in docs/SUMMARY.md");
    }
}
