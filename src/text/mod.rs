//! Foreign text and numbers at the borders of the program: each border has one helper, which everything from a file, a
//! peer or a device passes.
//!
//! | border | helper |
//! |---|---|
//! | a line on a terminal, in a log | [`one_line`] |
//! | several lines on a terminal | [`printable`] |
//! | KML, HTML, SVG | [`xml`] |
//! | CSV | [`csv_field`], [`csv_figure`] |
//! | JSON, GeoJSON | `serde_json` for text, [`finite`] for numbers |
//! | numbers from people or files | [`number`] |

use std::borrow::Cow;
use std::fmt::Write as _;

/// Characters that a terminal does not show as text: control characters, and those that change the direction of the
/// following text or break a line invisibly (Unicode, annex 9 and 14).
fn is_steering(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}'
            | '\u{feff}' | '\u{fff9}'..='\u{fffb}')
}

/// Writes such a character in its escaped form: `\n`, `\u{1b}`.
pub fn put_shown(out: &mut String, c: char) {
    match c {
        c if is_steering(c) => out.extend(c.escape_default()),
        c => out.push(c),
    }
}

fn shown(text: &str, stays: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.chars().any(|c| is_steering(c) && !stays(c)) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if stays(c) { out.push(c) } else { put_shown(&mut out, c) }
    }
    Cow::Owned(out)
}

/// Whether the text can be in a line unchanged.
pub fn is_one_line(text: &str) -> bool {
    !text.chars().any(is_steering)
}

/// One line for a terminal or a log: characters that move the cursor, or change colour, direction or line, are escaped.
pub fn one_line(text: &str) -> Cow<'_, str> {
    shown(text, |_| false)
}

/// Lines for a terminal: as [`one_line`], but line ends and tabs are kept.
pub fn printable(text: &str) -> Cow<'_, str> {
    shown(text, |c| matches!(c, '\n' | '\t'))
}

/// The system's message without its number: `No such file or directory`, not `… (os error 2)`.
pub fn without_numbers(words: &str) -> Cow<'_, str> {
    const BEGIN: &str = " (os error ";
    let mut words = Cow::Borrowed(words);
    while let Some(at) = words.find(BEGIN) {
        let after = &words[at + BEGIN.len()..];
        let digits = after.bytes().take_while(u8::is_ascii_digit).count();
        if digits == 0 || !after[digits..].starts_with(')') {
            break;
        }
        words = Cow::Owned(format!("{}{}", &words[..at], &after[digits + 1..]));
    }
    words
}

/// Text inside XML and HTML, in elements and in quoted attributes. Characters that are not allowed in XML are left out.
pub fn xml(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            '\n' | '\t' => out.push(c),
            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => {}
            c => out.push(c),
        }
    }
    out
}

/// A text field of a table (RFC 4180): quoted where it has a comma, a quote or a line end. A text that a spreadsheet
/// would take for a formula gets an apostrophe before it, which spreadsheets show as text.
pub fn csv_field(text: &str) -> Cow<'_, str> {
    let formula =
        text.starts_with(['=', '+', '-', '@', '\t', '\r', '\u{ff1d}', '\u{ff0b}', '\u{ff0d}', '\u{ff20}']);
    let quoted = text.contains([',', '"', '\n', '\r', ';', '\t']);
    if !formula && !quoted {
        return one_line(text);
    }
    let mut out = String::from("\"");
    if formula {
        out.push('\'');
    }
    for c in text.chars() {
        match c {
            '"' => out.push_str("\"\""),
            c => put_shown(&mut out, c),
        }
    }
    out.push('"');
    Cow::Owned(out)
}

/// Appends a comma and a number to a row of a table; the field stays empty where the number is not finite.
pub fn csv_figure(row: &mut String, figure: f64, decimals: usize) {
    row.push(',');
    if figure.is_finite() {
        // Writing to a string cannot fail.
        let _ = write!(row, "{figure:.decimals$}");
    }
}

/// The number, if it is finite.
pub fn finite(figure: f64) -> Option<f64> {
    figure.is_finite().then_some(figure)
}

/// A number from a person or a file; `nan`, `inf` and words are refused.
///
/// # Errors
/// What is wrong, as text.
pub fn number(text: &str) -> Result<f64, String> {
    let figure = text.trim().parse().ok().and_then(finite);
    figure.ok_or_else(|| format!("{:?} is not a number", text.trim()))
}

/// `1 thing`, `2 things`: a count with a noun whose plural is regular.
pub fn counted(count: usize, what: &str) -> String {
    if count == 1 { format!("1 {what}") } else { format!("{count} {what}s") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_that_steers_a_terminal_passes() {
        assert_eq!(one_line("plain ±0.5 °, π, 飛行"), "plain ±0.5 °, π, 飛行");
        assert_eq!(one_line("\x1b]0;title\x07\x1b[2J"), r"\u{1b}]0;title\u{7}\u{1b}[2J");
        assert_eq!(one_line("line\nlevel=info\r\u{9b}31m"), r"line\nlevel=info\r\u{9b}31m");
        assert_eq!(one_line("a\u{202e}b\u{2028}c"), r"a\u{202e}b\u{2028}c");
        assert_eq!(printable("a\tb\nc\u{1b}"), "a\tb\nc\\u{1b}");
        assert!(is_one_line("unchanged") && !is_one_line("two\nlines"));
    }

    #[test]
    fn the_systems_numbers_are_for_nobody() {
        assert_eq!(
            without_numbers("cannot read a: No such file or directory (os error 2)"),
            "cannot read a: No such file or directory"
        );
        assert_eq!(without_numbers("a (os error 2): b (os error 13)!"), "a: b!");
        assert_eq!(without_numbers("a (os error x)"), "a (os error x)");
    }

    #[test]
    fn names_become_neither_markup_nor_formulas() {
        assert_eq!(xml("a<b & \"c\"\u{7}"), "a&lt;b &amp; &quot;c&quot;");
        assert_eq!(csv_field("ugv-1"), "ugv-1");
        assert_eq!(csv_field("=HYPERLINK(\"http://x\",1)"), "\"'=HYPERLINK(\"\"http://x\"\",1)\"");
        for formula in ["+1", "-1", "@x", "=1", "\t=1"] {
            assert!(csv_field(formula).starts_with("\"'"), "{formula:?}");
        }
        assert_eq!(csv_field("a,b\nc"), "\"a,b\\nc\"");
    }

    #[test]
    fn what_is_no_number_is_none() {
        for wrong in ["nan", "NaN", "inf", "-inf", "infinity", "", "x", "1e999"] {
            assert!(number(wrong).is_err(), "{wrong}");
        }
        assert_eq!(number(" -1.5e3 "), Ok(-1500.0));
        let mut row = String::from("1");
        for figure in [1.23456, f64::NAN, f64::NEG_INFINITY, -0.5] {
            csv_figure(&mut row, figure, 2);
        }
        assert_eq!(row, "1,1.23,,,-0.50");
    }
}
