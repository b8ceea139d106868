//! `midshift backup` and `midshift restore`.

use midshift_backup::{Access, AccessOutcome, Identity, KEYS, Places, Summary};
use midshift_cli::client::Exit;
use midshift_cli::out::{Format, Out, columns};
use midshift_process::clock;
use midshift_proto::convert::timestamp;
use midshift_server::storage::Database;
use std::path::{Path, PathBuf};

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
    /// What was revoked, the newest list that is left: revocations.jsonl in the folder identity of the lost server, or the copy in the folder stop of its stop
    /// service. What it names stays out, and so do secrets that waited for their machine.
    #[arg(long, value_name = "FILE")]
    revocations: Option<PathBuf>,
    /// What becomes of tokens and robots without that list, or re-issue beside it.
    #[arg(long, value_enum)]
    identity: Option<Identity>,
    /// Only look whether everything is there and as it was copied; write nothing, and ask no database.
    #[arg(long, conflicts_with_all = ["data", "ota_keys", "revocations", "identity"])]
    verify: bool,
}

/// Copies everything durable of a server, and prints a summary of the copy.
pub async fn back_up(args: &Take, out: &Out) -> Result<(), Exit> {
    let from = Places { data: args.data.clone(), ota_keys: args.ota_keys.clone(), store: args.database.postgres()? };
    let summary = midshift_backup::back_up(&from, &args.to, clock::clock(1000).now().wall).await?;
    show(&summary, None, out)?;
    // The backup is whole, whether or not that can be said.
    if let Err(error) = midshift_backup::audit_notices::leave_note(&from.data, &summary, &args.to) {
        out.inform(&format!("warning: the audit will have no row of this backup: {error:#}"));
    }
    out.next(&format!("midshift restore --verify --from {}", word(&args.to.to_string_lossy())));
    Ok(())
}

/// Verifies, and restores if asked to.
pub async fn restore(args: &Restore, out: &Out) -> Result<(), Exit> {
    let Some(data) = args.data.clone() else {
        if args.database.store.is_some() {
            out.inform("--verify reads the backup only and asks no database");
        }
        return show(&midshift_backup::verify(&args.from).await?, None, out);
    };
    let to = Places { data, ota_keys: args.ota_keys.clone(), store: args.database.postgres()? };
    let access = Access { revocations: args.revocations.clone(), identity: args.identity };
    let (summary, settled) = midshift_backup::restore(&args.from, &to, &access, clock::clock(1000).now().wall).await?;
    if let Err(error) = midshift_backup::audit_notices::leave_restored(&to.data, &args.from, &access, &settled) {
        out.inform(&format!("warning: the audit will have no row of this restore: {error:#}"));
    }
    show(&summary, Some(&settled), out)?;
    who_is_let_in(&access, &settled).iter().for_each(|line| out.inform(line));
    let keys = summary.has_keys().then(|| to.ota_keys.clone().unwrap_or_else(|| to.data.join(KEYS)));
    let (note, command) = serve(&to.data, args.database.store.as_deref(), keys.as_deref());
    note.iter().for_each(|note| out.inform(note));
    out.next(&command);
    Ok(())
}

/// What a person is told of tokens and robots.
fn who_is_let_in(access: &Access, settled: &AccessOutcome) -> Vec<String> {
    let mut lines = Vec::new();
    match (&access.revocations, access.identity) {
        (None, None) => {}
        (None, Some(Identity::AsBackedUp)) => lines.push(
            "tokens and robots are let in as they were at the backup: revoke again what was revoked since".to_owned(),
        ),
        (list, identity) => {
            lines.push(format!("taken back: {} tokens, {} keys of robots", settled.tokens, settled.keys));
            if list.is_none() && identity.is_some() {
                lines.push(
                    "robots are let in as they were at the backup: revoke again those that were revoked since"
                        .to_owned(),
                );
            }
            if settled.secret.is_none() && settled.is_orphaned {
                lines.push(
                    "no token of the backup may administer the site any more: start the server with --spare-token"
                        .to_owned(),
                );
            }
        }
    }
    lines
}

/// The command that starts a server of a restored directory, and what must be done before it. No password is in either.
fn serve(data: &Path, store: Option<&str>, keys: Option<&Path>) -> (Option<String>, String) {
    let mut command = format!("midshift serve --data {}", word(&data.to_string_lossy()));
    let mut note = None;
    match store.map(|url| (url, without_password(url))) {
        Some((url, shown)) if url == shown => command += &format!(" --store {}", word(url)),
        Some((_, shown)) => {
            note = Some(format!(
                "set MIDSHIFT_STORE to the address of the database, {shown} with its password, which is not shown here"
            ));
        }
        None => {}
    }
    if let Some(keys) = keys {
        command += &format!(" --ota-keys {}", word(&keys.to_string_lossy()));
    }
    (note, command)
}

/// An address of PostgreSQL as it may be shown: a password can stand before the host and among the parameters.
fn without_password(url: &str) -> String {
    let (scheme, rest) = url.split_once("://").unwrap_or(("postgres", url));
    let (place, parameters) = rest.split_once('?').map_or((rest, None), |(place, after)| (place, Some(after)));
    // A password may hold an @ or a slash that nobody encoded: what is before the last @ is the user's.
    let place = match place.rsplit_once('@') {
        Some((user, host)) => format!("{}@{host}", user.split(':').next().unwrap_or_default()),
        None => place.to_owned(),
    };
    let kept = parameters.into_iter().flat_map(|all| all.split('&'));
    let kept: Vec<&str> = kept.filter(|one| !one.to_ascii_lowercase().starts_with("password=")).collect();
    let parameters = if kept.is_empty() { String::new() } else { format!("?{}", kept.join("&")) };
    format!("{scheme}://{place}{parameters}")
}

/// One word of a shell.
fn word(text: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./:@%+=,".contains(c);
    if !text.is_empty() && text.chars().all(is_plain) {
        return text.to_owned();
    }
    format!("'{}'", text.replace('\'', "'\\''"))
}

/// What is in a backup; of one that was restored, what became of tokens and robots too.
fn show(summary: &Summary, settled: Option<&AccessOutcome>, out: &Out) -> Result<(), Exit> {
    let begun = timestamp(summary.begun).to_string();
    match out.format {
        Format::Table => {
            let rows: Vec<Vec<String>> = summary
                .parts
                .iter()
                .map(|(name, files, bytes)| vec![name.clone(), files.to_string(), bytes.to_string()])
                .collect();
            out.line(&columns(&["PART", "FILES", "BYTES"], &rows));
            out.inform(&format!("site {}, begun {begun}", summary.site_id));
            if let Some(secret) = settled.and_then(|settled| settled.secret.as_ref()) {
                out.line(&format!(
                    "A token that may do everything on this site, for a year. It is shown once:\n\n  {secret}\n"
                ));
            }
        }
        Format::Name => summary.parts.iter().for_each(|(name, ..)| out.line(name)),
        Format::Json | Format::Jsonl => {
            let part = |(name, files, bytes): &(String, u64, u64)| serde_json::json!({"name": name, "files": files, "bytes": bytes.to_string()});
            let mut value = serde_json::json!({
                "siteId": summary.site_id,
                "begun": begun,
                "parts": summary.parts.iter().map(part).collect::<Vec<_>>(),
            });
            if let (Some(settled), Some(fields)) = (settled, value.as_object_mut()) {
                fields.insert("tokensTakenBack".to_owned(), settled.tokens.into());
                fields.insert("keysTakenBack".to_owned(), settled.keys.into());
                fields.extend(settled.secret.iter().map(|secret| ("token".to_owned(), secret.as_str().into())));
            }
            out.value(&value)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_that_comes_next_can_be_pasted_and_has_no_password() {
        let (data, keys) = (Path::new("new data"), Path::new("new data/ota-keys"));
        assert_eq!(serve(Path::new("data"), None, None), (None, "midshift serve --data data".to_owned()));
        let open = "postgres://postgres@localhost/site?host=/run/pg&application_name=a";
        let (note, command) = serve(data, Some(open), Some(keys));
        assert_eq!(note, None);
        assert_eq!(
            command,
            format!("midshift serve --data 'new data' --store '{open}' --ota-keys 'new data/ota-keys'")
        );
        for secret in [
            "postgresql://ana:s3cret@db:5433/site",
            "postgres://ana:s3c/r@s3cret@db/site",
            "postgres://ana@db/site?sslmode=disable&password=s3cret",
            "postgres://db/site?PASSWORD=s3cret",
        ] {
            let (note, command) = serve(data, Some(secret), None);
            assert_eq!(command, "midshift serve --data 'new data'", "{secret}");
            let note = note.expect("what to do first");
            assert!(note.contains("MIDSHIFT_STORE") && note.contains("/site"), "{note}");
            assert!(!note.contains("s3c"), "{note}");
        }
    }

    #[test]
    fn whoever_restores_is_told_who_is_let_in_and_what_is_left_to_do() {
        let said = |revocations: Option<&str>, identity, settled: &AccessOutcome| {
            let access = Access { revocations: revocations.map(Into::into), identity };
            who_is_let_in(&access, settled).join("\n")
        };
        let settled = AccessOutcome { tokens: 2, keys: 1, ..AccessOutcome::default() };
        assert_eq!(said(None, None, &settled), "", "there is nobody");
        assert!(said(None, Some(Identity::AsBackedUp), &settled).contains("revoke again what was revoked since"));
        assert_eq!(said(Some("list"), None, &settled), "taken back: 2 tokens, 1 keys of robots");
        let orphaned = AccessOutcome { is_orphaned: true, ..settled.clone() };
        assert!(said(Some("list"), None, &orphaned).contains("--spare-token"));
        let issued = AccessOutcome { secret: Some("mst.x".to_owned()), ..settled };
        let told = said(None, Some(Identity::ReIssue), &issued);
        assert!(!told.contains("mst.x") && told.contains("robots are let in as they were"), "{told}");
        assert!(!format!("{issued:?}").contains("mst.x"), "no log has it");
    }

    #[test]
    fn a_word_of_a_shell_is_quoted_where_it_must_be() {
        assert_eq!(["a/b.c", "a b", "it's", ""].map(word), ["a/b.c", "'a b'", "'it'\\''s'", "''"]);
    }
}
