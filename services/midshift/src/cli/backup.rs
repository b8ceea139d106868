//! `midshift backup` and `midshift restore`.

use super::client::Exit;
use super::out::{Format, Out, columns};
use crate::backup::{self, Places, Summary};
use crate::clock;
use crate::storage::Database;
use midshift_proto::convert::timestamp;
use std::path::PathBuf;

/// What to copy.
#[derive(Clone, Debug, clap::Args)]
pub struct Take {
    /// The data directory of the server; with --store that of a process with role ota, whose software is copied too.
    #[arg(long, default_value = "midshift-data")]
    data: PathBuf,
    /// Its rows and samples, if they are elsewhere.
    #[command(flatten)]
    database: Database,
    /// The folder of its online keys, if it was given one. Whoever has the backup has these keys.
    #[arg(long, value_name = "DIR")]
    ota_keys: Option<PathBuf>,
    /// The folder to make. It must not be there, not even empty.
    #[arg(long)]
    to: PathBuf,
}

/// What to make of a backup.
#[derive(Clone, Debug, clap::Args)]
pub struct Restore {
    /// The backup.
    #[arg(long)]
    from: PathBuf,
    /// The data directory to make. It must not be there, not even empty.
    #[arg(long, required_unless_present = "verify")]
    data: Option<PathBuf>,
    /// Where rows and samples of a backup of PostgreSQL go. The database must be there, and have no row of midshift.
    #[command(flatten)]
    database: Database,
    /// The folder to make for online keys, which must not be there; without it the folder ota-keys of the data directory.
    #[arg(long, value_name = "DIR")]
    ota_keys: Option<PathBuf>,
    /// Only look whether everything is there and as it was copied; write nothing, and ask no database.
    #[arg(long, conflicts_with_all = ["data", "ota_keys"])]
    verify: bool,
}

/// Copies.
pub async fn take(args: &Take, out: &Out) -> Result<(), Exit> {
    let from = Places { data: args.data.clone(), ota_keys: args.ota_keys.clone(), store: args.database.postgres()? };
    let summary = backup::back_up(&from, &args.to, clock::clock(1000).now().wall).await?;
    show(&summary, out)?;
    out.next(&format!("midshift restore --verify --from {}", args.to.display()));
    Ok(())
}

/// Verifies, and restores if asked to.
pub async fn restore(args: &Restore, out: &Out) -> Result<(), Exit> {
    let Some(data) = args.data.clone() else {
        if args.database.store.is_some() {
            out.say("--verify reads the backup only and asks no database");
        }
        return show(&backup::verify(&args.from).await?, out);
    };
    let to = Places { data, ota_keys: args.ota_keys.clone(), store: args.database.postgres()? };
    let summary = backup::restore(&args.from, &to, clock::clock(1000).now().wall).await?;
    show(&summary, out)?;
    let store = if to.store.is_some() { " --store postgres://…" } else { "" };
    out.next(&format!("midshift serve --data {}{store}", to.data.display()));
    Ok(())
}

fn show(summary: &Summary, out: &Out) -> Result<(), Exit> {
    let begun = timestamp(summary.begun).to_string();
    match out.format {
        Format::Table => {
            let rows: Vec<Vec<String>> = summary
                .parts
                .iter()
                .map(|(name, files, bytes)| vec![name.clone(), files.to_string(), bytes.to_string()])
                .collect();
            out.line(&columns(&["PART", "FILES", "BYTES"], &rows));
            out.say(&format!("site {}, begun {begun}", summary.site_id));
        }
        Format::Name => summary.parts.iter().for_each(|(name, ..)| out.line(name)),
        Format::Json | Format::Jsonl => {
            let part = |(name, files, bytes): &(String, u64, u64)| serde_json::json!({"name": name, "files": files, "bytes": bytes.to_string()});
            out.value(&serde_json::json!({
                "siteId": summary.site_id,
                "begun": begun,
                "parts": summary.parts.iter().map(part).collect::<Vec<_>>(),
            }))?;
        }
    }
    Ok(())
}
