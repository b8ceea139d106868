//! `midshift audit …`: who decided what, taken away as a file, and whether anything of it was changed.

use super::client::{Call, Exit, unary};
use super::duration;
use super::out::{Format, Out, columns};
use super::pages::{self, Listed, PAGE_SIZE};
use anyhow::Context;
use clap::Subcommand;
use midshift_core::audit::{Export, Head, Held, Mark};
use midshift_core::time::Utc;
use midshift_proto::convert::{time_of, timestamp};
use midshift_proto::identity::v1;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Of what one row is about, so much stands in a table.
const ABOUT_SHOWN: usize = 4;

/// How far a verification is, is said from so many rows on.
const TOLD_FROM: u64 = 1_000;

/// Verbs of the audit.
#[derive(Subcommand)]
pub enum Verb {
    /// List what was decided, the newest first.
    Ls {
        #[command(flatten)]
        call: Call,
        /// Only by this service: task, fleet, ota, stop, identity.
        #[arg(long, default_value = "", hide_default_value = true)]
        service: String,
        /// Only asked for by this person or program.
        #[arg(long, default_value = "", hide_default_value = true)]
        actor: String,
        /// Only about this robot.
        #[arg(long, default_value = "", hide_default_value = true)]
        robot: String,
        /// Only about this: any id, or kind and id as in task:T-1.
        #[arg(long, default_value = "", hide_default_value = true)]
        subject: String,
        /// Only actions that begin with this, as in rollout.
        #[arg(long, default_value = "", hide_default_value = true)]
        action: String,
        /// Only from then on: 2026-11-22T06:00:00Z, or how long ago, as in 8h.
        #[arg(long, value_parser = moment)]
        since: Option<Utc>,
        /// Only before then.
        #[arg(long, value_parser = moment)]
        until: Option<Utc>,
        /// At most so many rows; 0: all.
        #[arg(long, default_value_t = 1_000)]
        limit: usize,
    },
    /// Write all of it as lines of JSON, byte for byte as stored, with the newest row of each chain in the first line.
    Export {
        #[command(flatten)]
        call: Call,
        /// Into this file, which must not be there; without it to stdout.
        #[arg(long)]
        out: Option<PathBuf>,
    },
    /// Check that no row was changed, taken away or moved: of the server, or of an export. Exit code 1 names the first row that shows it.
    Verify {
        #[command(flatten)]
        call: Call,
        /// This export instead of the server.
        #[arg(long)]
        file: Option<PathBuf>,
        /// A row that you noted down, SERVICE:NUMBER:HASH, which must still be there. May be given again.
        #[arg(long, value_parser = mark)]
        head: Vec<Mark>,
    },
}

fn moment(text: &str) -> Result<Utc, String> {
    if let Some(at) = Utc::parse_rfc3339(text) {
        return Ok(at);
    }
    let ago = duration(text).map_err(|_| "must be as 2026-11-22T06:00:00Z, or how long ago, as 8h".to_owned())?;
    Ok(Utc(midshift_agent::clock::wall().0 - ago.as_millis() as i64))
}

fn mark(text: &str) -> Result<Mark, String> {
    Mark::parse(text)
        .ok_or_else(|| "must be SERVICE:NUMBER:HASH, as `audit verify` and `audit export` print it".to_owned())
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Ls { call, service, actor, robot, subject, action, since, until, limit } => {
            let request = v1::ListAuditRequest {
                service,
                actor,
                robot_id: robot,
                subject,
                action_prefix: action,
                since: since.map(timestamp),
                until: until.map(timestamp),
                page_size: PAGE_SIZE,
                page_token: String::new(),
            };
            list(&call, request, if limit == 0 { usize::MAX } else { limit }, out).await
        }
        Verb::Export { call, out: None } => export(&call, |line| {
            out.line(line);
            Ok(())
        })
        .await
        .map(drop),
        Verb::Export { call, out: Some(path) } => export_to(&call, &path, out).await,
        Verb::Verify { file: Some(path), head, .. } => print_verification(&read(&path, &head)?, out),
        Verb::Verify { call, file: None, head } => print_verification(&verify(&call, head, out).await?, out),
    }
}

async fn list(call: &Call, request: v1::ListAuditRequest, limit: usize, out: &Out) -> Result<(), Exit> {
    let mut client = call.audit().await?;
    let read =
        async |page_token| client.list_audit(unary(v1::ListAuditRequest { page_token, ..request.clone() })).await;
    let mut whole = pages::first(limit, read).await?;
    let is_cut = whole.rows.len() > limit || !whole.next_page_token.is_empty();
    whole.rows.truncate(limit);
    out.list(&whole)?;
    if is_cut {
        out.next("older rows: the same with --until, or --limit 0 for all");
    }
    Ok(())
}

impl Listed for v1::AuditRow {
    const HEADER: &'static [&'static str] = &["AT", "ROW", "ACTOR", "ACTION", "ABOUT", "OUTCOME", "REASON"];
    fn name(&self) -> String {
        format!("{}:{}", self.service, self.n)
    }
    fn row(&self) -> Vec<String> {
        let heads = self.heads.iter().map(|head| format!("{}:{}", head.service, head.n));
        let mut about: Vec<String> = self.about.iter().cloned().chain(heads).collect();
        if about.len() > ABOUT_SHOWN {
            let more = about.len() - ABOUT_SHOWN;
            about.truncate(ABOUT_SHOWN);
            about.push(format!("and {more} more"));
        }
        vec![
            self.time.as_ref().map(|t| time_of(t).rfc3339()).unwrap_or_default(),
            self.name(),
            self.actor.clone(),
            self.action.clone(),
            about.join(" "),
            self.outcome.clone(),
            self.reason.clone(),
        ]
    }
}

/// Hands over each line of an export, and gives back the first.
async fn export(call: &Call, mut take: impl FnMut(&str) -> anyhow::Result<()>) -> Result<Export, Exit> {
    let mut stream = call.audit().await?.export_audit(v1::ExportAuditRequest {}).await?.into_inner();
    let mut first = None;
    while let Some(message) = stream.message().await? {
        for line in &message.lines {
            take(line)?;
            if first.is_none() {
                first = Some(
                    Export::parse(line).context("the server's export is of a form that this build does not know")?,
                );
            }
        }
    }
    first.ok_or_else(|| Exit::new(1, "the server sent nothing"))
}

async fn export_to(call: &Call, path: &Path, out: &Out) -> Result<(), Exit> {
    let file = OpenOptions::new().write(true).create_new(true).open(path);
    let file = file.with_context(|| format!("creating {}", path.display()))?;
    let mut writer = BufWriter::new(file);
    let mut lines = 0_u64;
    let written = export(call, |line| {
        lines += 1;
        writeln!(writer, "{line}").context("writing the export")
    });
    let written = written.await.and_then(|export| {
        let synced = writer.into_inner().map_err(|e| e.into_error()).and_then(|file| file.sync_all());
        synced.context("writing the export").map(|()| export).map_err(Exit::from)
    });
    let export = match written {
        Ok(export) => export,
        Err(exit) => {
            // Half an export would not hold, and stand in the way of a whole one.
            let _ = std::fs::remove_file(path);
            return Err(exit);
        }
    };
    out.inform(&format!("{} rows in {}", lines.saturating_sub(1), path.display()));
    for (service, head) in &export.heads {
        match out.format {
            Format::Json | Format::Jsonl => {}
            Format::Table | Format::Name => out.line(&format!("{service}:{head}")),
        }
    }
    if matches!(out.format, Format::Json | Format::Jsonl) {
        out.value(&serde_json::to_value(&export).context("the first line")?)?;
    }
    out.next(&format!(
        "midshift audit verify --file {}; keep it, or these lines, where this server cannot write",
        path.display()
    ));
    Ok(())
}

/// What came out for each chain of an export.
fn read(path: &Path, noted: &[Mark]) -> Result<v1::VerifyAuditResponse, Exit> {
    let open = || File::open(path).with_context(|| format!("reading {}", path.display())).map(BufReader::new);
    let lines = || open().map(|file| file.lines().map(|line| line.context("reading the export")));
    let mut first = lines()?;
    let export = first.next().transpose()?.and_then(|line| Export::parse(&line));
    let export =
        export.ok_or_else(|| Exit::new(1, format!("{} does not begin like an export of the audit", path.display())))?;
    // Anchors first: what they quote may stand before them.
    let mut marks = noted.to_vec();
    for line in first {
        marks.extend(Mark::in_line(&line?));
    }
    let (mut held, mut rows_read) = (Held::new(&export, &marks, midshift_agent::clock::wall()), 0);
    for line in lines()?.skip(1) {
        held.add_line(&line?);
        rows_read += 1;
    }
    let verdicts = held.finish().into_iter().map(|(service, verdict)| {
        let head = |head: &Head| v1::AuditHead { service: service.clone(), n: head.n, hash: head.hash.clone() };
        match verdict {
            Ok(held) => v1::AuditVerdict {
                head: Some(head(&held.head)),
                rows: held.rows,
                first: held.first,
                service,
                broken: None,
            },
            Err(broken) => {
                let (what, n, text) = (broken.word().to_owned(), broken.row(), broken.to_string());
                let broken = Some(v1::AuditBreak { what, n, text });
                v1::AuditVerdict { service, broken, ..v1::AuditVerdict::default() }
            }
        }
    });
    Ok(v1::VerifyAuditResponse { rows_read, verdicts: verdicts.collect() })
}

async fn verify(call: &Call, noted: Vec<Mark>, out: &Out) -> Result<v1::VerifyAuditResponse, Exit> {
    let head = |mark: Mark| v1::AuditHead { service: mark.service, n: mark.head.n, hash: mark.head.hash };
    let request = v1::VerifyAuditRequest { heads: noted.into_iter().map(head).collect() };
    let mut stream = call.audit().await?.verify_audit(request).await?.into_inner();
    while let Some(message) = stream.message().await? {
        if !message.verdicts.is_empty() {
            return Ok(message);
        }
        // Between chains that hardly have rows there is nothing to tell.
        if message.rows_read >= TOLD_FROM {
            out.inform(&format!("{} rows read", message.rows_read));
        }
    }
    Err(Exit::new(5, "the server ended before it was through\n  try: the same again"))
}

/// Prints what came out. An error names the first row that shows that something was changed.
fn print_verification(answer: &v1::VerifyAuditResponse, out: &Out) -> Result<(), Exit> {
    let head = |verdict: &v1::AuditVerdict| {
        verdict
            .head
            .as_ref()
            .filter(|h| h.n > 0)
            .map(|h| format!("{}:{}:{}", h.service, h.n, h.hash))
            .unwrap_or_default()
    };
    match out.format {
        Format::Table => {
            let row = |verdict: &v1::AuditVerdict| {
                let from = if verdict.first > 1 { format!("from {}", verdict.first) } else { String::new() };
                let word = verdict.broken.as_ref().map_or("holds", |broken| &broken.what);
                vec![verdict.service.clone(), word.to_owned(), verdict.rows.to_string(), from, head(verdict)]
            };
            let rows: Vec<_> = answer.verdicts.iter().map(row).collect();
            out.line(columns(&["CHAIN", "VERDICT", "ROWS", "CUT", "HEAD"], &rows).trim_end());
        }
        Format::Name => {
            answer.verdicts.iter().map(head).filter(|head| !head.is_empty()).for_each(|head| out.line(&head))
        }
        Format::Json | Format::Jsonl => out.json(answer)?,
    }
    let broken = answer.verdicts.iter().filter_map(|v| Some((&v.service, v.broken.as_ref()?)));
    let broken: Vec<String> = broken.map(|(service, broken)| format!("{service}: {}", broken.text)).collect();
    if broken.is_empty() {
        out.next("note the heads down where this server cannot write, and give them to --head another time");
        return Ok(());
    }
    Err(Exit::new(1, format!("the audit does not hold:\n  {}", broken.join("\n  "))).or_try(
        "compare with an export that you kept (audit verify --file), and find out who can write to the database",
    ))
}

#[cfg(test)]
mod tests;
