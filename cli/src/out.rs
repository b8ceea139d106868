//! Where the command line prints: data to stdout, talk to stderr. Works without colour.

use crate::pages::{Listed, Page};
use clap::ValueEnum;
use prost::{Message, Name};
use std::borrow::Cow;
use std::io::{ErrorKind, Write};
use std::sync::OnceLock;

/// How results may be asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Output {
    /// Columns for people.
    Table,
    /// One JSON document: proto3-JSON, the stable contract.
    Json,
    /// One JSON object a line.
    Jsonl,
    /// Only ids, one a line.
    Name,
    /// One HTML page. Only `rollout report` makes one.
    Html,
}

/// How results are printed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Columns for people.
    Table,
    /// One JSON document: proto3-JSON, the stable contract.
    Json,
    /// One JSON object a line.
    Jsonl,
    /// Only ids, one a line.
    Name,
}

/// The two streams.
pub struct Out {
    /// Asked for.
    pub format: Format,
    /// A page is asked for.
    page: bool,
    /// Why data could not be written.
    unwritten: OnceLock<ErrorKind>,
}

impl Out {
    /// Prints as asked.
    pub fn new(format: Format) -> Self {
        Self { format, page: false, unwritten: OnceLock::new() }
    }
    /// Prints as the command line asks for it.
    pub fn for_output(output: Output) -> Self {
        let format = match output {
            Output::Table | Output::Html => Format::Table,
            Output::Json => Format::Json,
            Output::Jsonl => Format::Jsonl,
            Output::Name => Format::Name,
        };
        Self { page: output == Output::Html, ..Self::new(format) }
    }
    /// A page is asked for.
    pub fn is_page(&self) -> bool {
        self.page
    }
    /// A line of data; for people without anything that their terminal would obey.
    pub fn line(&self, text: &str) {
        let text = if self.format == Format::Table { lines(text) } else { text.into() };
        // A reader that went away is no error of ours.
        if let Err(error) = writeln!(std::io::stdout().lock(), "{text}") {
            let _known = self.unwritten.set(error.kind());
        }
    }
    /// Why data could not be written: what goes on for a reader alone ends then. [`ErrorKind::BrokenPipe`]: nobody reads.
    pub fn unwritten(&self) -> Option<ErrorKind> {
        self.unwritten.get().copied()
    }
    /// Prints a word to the person, which no program reads.
    pub fn inform(&self, text: &str) {
        let _ = writeln!(std::io::stderr().lock(), "{}", lines(text));
    }
    /// What to do next, for a person only.
    pub fn next(&self, text: &str) {
        if self.format == Format::Table {
            self.inform(&format!("next: {text}"));
        }
    }
    /// A message as JSON.
    pub fn json<M: Message + Name>(&self, message: &M) -> anyhow::Result<()> {
        self.value(&midshift_proto::json::to_json(message)?)
    }
    /// A JSON document.
    pub fn value(&self, value: &serde_json::Value) -> anyhow::Result<()> {
        let text = if self.format == Format::Jsonl { value.to_string() } else { serde_json::to_string_pretty(value)? };
        self.line(&text);
        Ok(())
    }
    /// Columns for people; a terminal that is too narrow for all goes without those of `spare`, in that order.
    pub fn table(&self, header: &[&str], rows: &[Vec<String>], spare: &[&str]) {
        let width = console::Term::stdout().size_checked().map(|(_, columns)| usize::from(columns));
        let (text, left_out) = fitting(width, header, rows, spare);
        self.line(text.trim_end());
        if !left_out.is_empty() {
            self.inform(&format!("not shown, the terminal is narrow: {}", left_out.join(" ")));
        }
    }
    /// One object: a message, or its name, or lines for people.
    pub fn one<M: Message + Name>(
        &self,
        message: &M,
        name: &str,
        lines: impl FnOnce() -> String,
    ) -> anyhow::Result<()> {
        match self.format {
            Format::Table => self.line(lines().trim_end()),
            Format::Name => self.line(name),
            Format::Json | Format::Jsonl => self.json(message)?,
        }
        Ok(())
    }
    /// A list, in the columns of what is listed.
    pub fn list<P: Page<Item: Listed>>(&self, whole: &P) -> anyhow::Result<()> {
        self.many(whole, whole.items(), Listed::name, P::Item::HEADER, Listed::row)
    }
    /// Many objects: `whole` is the message that holds them.
    pub fn many<W: Message + Name, M: Message + Name>(
        &self,
        whole: &W,
        items: &[M],
        name: impl Fn(&M) -> String,
        header: &[&str],
        row: impl Fn(&M) -> Vec<String>,
    ) -> anyhow::Result<()> {
        match self.format {
            Format::Table => self.line(columns(header, &items.iter().map(row).collect::<Vec<_>>()).trim_end()),
            Format::Name => items.iter().for_each(|m| self.line(&name(m))),
            Format::Json => self.json(whole)?,
            Format::Jsonl => {
                for item in items {
                    self.json(item)?;
                }
            }
        }
        Ok(())
    }
}

/// What somebody typed, as it may stand in a line: a sign for each character that a terminal would obey, and for each that would begin a line or turn one around. Every
/// free text that is shown outside of [`columns`] goes through this.
pub fn plain(text: &str) -> Cow<'_, str> {
    shown(text, |_| false)
}

/// The same of whole lines.
fn lines(text: &str) -> Cow<'_, str> {
    shown(text, |c| c == '\n')
}

fn shown(text: &str, is_fine: impl Fn(char) -> bool) -> Cow<'_, str> {
    let is_bad = |c: char| is_obeyed(c) && !is_fine(c);
    match text.contains(is_bad) {
        true => text.replace(is_bad, "\u{fffd}").into(),
        false => text.into(),
    }
}

/// Control characters, line and paragraph separators, and what turns the direction of writing.
fn is_obeyed(c: char) -> bool {
    c.is_control() || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{200e}' | '\u{200f}')
}

/// Names that one cell shows.
const NAMES_SHOWN: usize = 3;

/// The first of some names and how many more there are: what one robot says must not make a table unreadable.
pub fn few(names: Vec<String>) -> Vec<String> {
    let more = names.len().saturating_sub(NAMES_SHOWN);
    let more = (more > 0).then(|| format!("+{more} more"));
    names.into_iter().take(NAMES_SHOWN).chain(more).collect()
}

/// Columns as wide as their widest cell. Ours: a crate for tables brings two more with it, and leaves no columns out by
/// how much they matter.
pub fn columns(header: &[&str], rows: &[Vec<String>]) -> String {
    let rows: Vec<Vec<Cow<'_, str>>> = rows.iter().map(|row| row.iter().map(|cell| plain(cell)).collect()).collect();
    let mut widths: Vec<usize> = header.iter().map(|h| h.len()).collect();
    for row in &rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = (*width).max(cell.chars().count());
        }
    }
    let line = |cells: Vec<&str>| {
        let padded: Vec<String> = cells.iter().zip(&widths).map(|(c, w)| format!("{c:<w$}")).collect();
        padded.join("  ").trim_end().to_owned()
    };
    let mut text = line(header.to_vec());
    for row in rows {
        text.push('\n');
        text += &line(row.iter().map(AsRef::as_ref).collect());
    }
    text
}

/// Columns in lines of at most `width` characters, and which of `spare` had to go for that. No width: all of them.
fn fitting<'s>(
    width: Option<usize>,
    header: &[&str],
    rows: &[Vec<String>],
    spare: &[&'s str],
) -> (String, Vec<&'s str>) {
    let is_wide = |text: &str| width.is_some_and(|width| text.lines().any(|line| line.chars().count() > width));
    let mut left_out = Vec::new();
    let mut text = columns(header, rows);
    for name in spare {
        if !is_wide(&text) {
            break;
        }
        left_out.push(*name);
        let is_kept = |at: &usize| !header.get(*at).is_some_and(|h| left_out.contains(h));
        let kept: Vec<usize> = (0..header.len()).filter(is_kept).collect();
        let narrow: Vec<&str> = kept.iter().filter_map(|at| header.get(*at).copied()).collect();
        let cells = |row: &Vec<String>| kept.iter().filter_map(|at| row.get(*at).cloned()).collect();
        text = columns(&narrow, &rows.iter().map(cells).collect::<Vec<_>>());
    }
    (text, left_out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_narrow_terminal_goes_without_the_columns_that_matter_least() {
        let rows = [vec!["r1".into(), "manual (3 min)".into(), "1.4.0".into(), "2.0 m/s".into()]];
        let header = ["ROBOT", "STATE", "SOFTWARE", "SPEED"];
        let spare = ["SOFTWARE", "SPEED"];
        let all = columns(&header, &rows);
        assert_eq!(fitting(None, &header, &rows, &spare), (all.clone(), vec![]));
        assert_eq!(fitting(Some(80), &header, &rows, &spare), (all, vec![]));
        let (text, left_out) = fitting(Some(30), &header, &rows, &spare);
        assert_eq!(
            (text.as_str(), left_out),
            ("ROBOT  STATE           SPEED\nr1     manual (3 min)  2.0 m/s", vec!["SOFTWARE"])
        );
        let (text, left_out) = fitting(Some(10), &header, &rows, &spare);
        assert_eq!(
            (text.lines().next(), left_out.len()),
            (Some("ROBOT  STATE"), 2),
            "the rest is wrapped by the terminal"
        );
    }

    #[test]
    fn of_many_names_three_are_shown_and_how_many_more_there_are() {
        let names = |n: usize| (1..=n).map(|n| format!("S{n}")).collect::<Vec<_>>();
        assert_eq!([0, 3].map(|n| few(names(n))), [names(0), names(3)]);
        assert_eq!(few(names(256)).join(", "), "S1, S2, S3, +253 more");
    }

    #[test]
    fn columns_line_up_and_end_without_spaces() {
        let text = columns(&["ID", "STATE"], &[vec!["a".into(), "QUEUED".into()], vec!["long".into(), String::new()]]);
        assert_eq!(text, "ID    STATE\na     QUEUED\nlong");
    }

    #[test]
    fn what_somebody_typed_neither_begins_a_line_nor_moves_the_cursor() {
        let typed = "x\nnothing is engaged\x1b[2J\r\u{9b}1A\u{202e}y";
        let sign = '\u{fffd}';
        let told = format!("x{sign}nothing is engaged{sign}[2J{sign}{sign}1A{sign}y");
        assert_eq!(plain(typed), told);
        assert_eq!(columns(&["REASON"], &[vec![typed.into()]]), format!("REASON\n{told}"));
        assert_eq!(lines(typed), told.replacen(sign, "\n", 1), "a line of ours may be several");
        assert_eq!(plain("größer, 走る"), "größer, 走る");
    }
}
