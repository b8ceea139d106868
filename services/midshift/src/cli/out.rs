//! Where the command line prints: data to stdout, talk to stderr. Works without colour.

use clap::ValueEnum;
use prost::{Message, Name};
use std::io::Write;

/// How results are printed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
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
}

impl Out {
    /// Prints as asked.
    pub fn new(format: Format) -> Self {
        Self { format }
    }
    /// A line of data.
    pub fn line(&self, text: &str) {
        // A reader that went away is no error of ours.
        let _ = writeln!(std::io::stdout().lock(), "{text}");
    }
    /// A word to the person.
    pub fn say(&self, text: &str) {
        let _ = writeln!(std::io::stderr().lock(), "{text}");
    }
    /// What to do next, for a person only.
    pub fn next(&self, text: &str) {
        if self.format == Format::Table {
            self.say(&format!("next: {text}"));
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

/// Columns as wide as their widest cell.
pub fn columns(header: &[&str], rows: &[Vec<String>]) -> String {
    let mut widths: Vec<usize> = header.iter().map(|h| h.len()).collect();
    for row in rows {
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
        text += &line(row.iter().map(String::as_str).collect());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_line_up_and_end_without_spaces() {
        let text = columns(&["ID", "STATE"], &[vec!["a".into(), "QUEUED".into()], vec!["long".into(), String::new()]]);
        assert_eq!(text, "ID    STATE\na     QUEUED\nlong");
    }
}
