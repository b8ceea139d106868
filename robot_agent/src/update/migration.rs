//! What is done to a robot's data once a set is committed: the set's program is called for each component that asks for
//! it.
//!
//! `PROGRAM midshift-migrate COMPONENT FROM TO`, with `-` for no version before; done when it ends with 0. Invariant:
//! it is called only after COMMITTED is on the ledger, one call at a time, and again until it is done: it must bear
//! being called twice, also while a call whose agent was killed still runs. A roll-back calls nothing.

use super::jobs::Failure;
use crate::storage::DueMigration;
use midshift_bundle::manifest::Migration;
use midshift_bundle::set::SetManifest;
use midshift_core::limits;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;
use tokio::process::Command;

/// First argument of the program when it is to migrate.
pub const VERB: &str = "midshift-migrate";
/// Where there was no version before.
const NOTHING: &str = "-";

/// What is due once `set` is committed after `kept`, of which `due` was not done yet.
pub(crate) fn due(set: &SetManifest, kept: &SetManifest, due: &[DueMigration]) -> Vec<DueMigration> {
    let asks = set.components.values().filter_map(|component| {
        let begun = due.iter().find(|d| d.component == component.name);
        let before = kept.components.get(&component.name);
        let changes = component.data_migration != Migration::None && before.map(|b| b.digest) != Some(component.digest);
        let from = match begun {
            Some(begun) => begun.from.clone(),
            None => before.map(|before| before.version.clone()),
        };
        let to = component.version.clone();
        (changes || begun.is_some()).then(|| DueMigration { component: component.name.clone(), from, to })
    });
    asks.collect()
}

/// Whether the set could do what its components ask for.
pub(crate) fn is_possible(set: &SetManifest) -> bool {
    set.program().is_some() || set.components.values().all(|c| c.data_migration == Migration::None)
}

/// Calls a program once, up to [`limits::MIGRATION_MS`].
pub(super) async fn call(program: &Path, set: &str, due: &DueMigration) -> Result<(), Failure> {
    let later = |why: String| Err(Failure::Later(why));
    let mut command = Command::new(program);
    command.args([VERB, &due.component, due.from.as_deref().unwrap_or(NOTHING), &due.to]);
    // Its output is not the agent's, which the launcher listens to.
    command.env(crate::launcher::SET, set).stdin(Stdio::null()).stdout(Stdio::null()).kill_on_drop(true);
    match tokio::time::timeout(Duration::from_millis(limits::MIGRATION_MS), command.status()).await {
        Ok(Ok(status)) if status.success() => Ok(()),
        Ok(Ok(status)) => later(status.to_string()),
        Ok(Err(error)) => later(format!("cannot be started: {error}")),
        Err(_) => later(format!("did not end within {} s", limits::MIGRATION_MS / 1_000)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_bundle::manifest::{Component, ComponentKind};
    use std::fs;
    use std::path::PathBuf;
    use tempfile::TempDir;

    fn component(name: &str, version: &str, data_migration: Migration) -> Component {
        let kind = if name == "gait" { ComponentKind::Process } else { ComponentKind::Config };
        let content = format!("{name} {version}");
        Component { data_migration, ..Component::new(name, version, kind, content.as_bytes()) }
    }

    fn set(components: &[Component]) -> SetManifest {
        let components = components.iter().map(|c| (c.name.clone(), c.clone())).collect();
        SetManifest { components, ..SetManifest::default() }
    }

    fn migration(component: &str, from: Option<&str>, to: &str) -> DueMigration {
        DueMigration { component: component.to_owned(), from: from.map(str::to_owned), to: to.to_owned() }
    }

    #[test]
    fn what_changed_and_asks_for_it_is_due_and_what_was_never_done_begins_where_it_began() {
        let [gait, map] =
            [component("gait", "1.0.0", Migration::None), component("map", "1.0.0", Migration::Reversible)];
        let kept = set(&[gait.clone(), map.clone()]);
        let next = set(&[
            component("gait", "1.1.0", Migration::Reversible),
            map,
            component("hands", "1.0.0", Migration::Irreversible),
            component("tone", "1.0.0", Migration::None),
        ]);
        let expected = [migration("gait", Some("1.0.0"), "1.1.0"), migration("hands", None, "1.0.0")];
        assert_eq!(due(&next, &kept, &[]), expected);
        let later =
            set(&[component("gait", "1.2.0", Migration::None), component("map", "1.0.0", Migration::Reversible)]);
        assert_eq!(due(&later, &next, &expected), [migration("gait", Some("1.0.0"), "1.2.0")]);
    }

    #[test]
    fn a_set_without_a_program_cannot_migrate() {
        let asks = component("map", "1.0.0", Migration::Reversible);
        assert!(!is_possible(&set(std::slice::from_ref(&asks))));
        assert!(is_possible(&set(&[asks, component("gait", "1.0.0", Migration::None)])));
        assert!(is_possible(&set(&[component("map", "1.0.0", Migration::None)])));
    }

    /// A program of this script.
    fn program(script: &str) -> (TempDir, PathBuf) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("program");
        let write = "printf '#!/bin/sh\\n%s\\n' \"$1\" > \"$2\" && chmod +x \"$2\"";
        let status = std::process::Command::new("sh").args(["-c", write, "sh", script]).arg(&path).status();
        assert!(status.expect("runs").success());
        (folder, path)
    }

    #[tokio::test]
    async fn a_program_is_told_what_to_migrate_and_its_end_says_whether_it_did() {
        let (folder, path) = program("echo \"$MIDSHIFT_SET $@\" >> ${0%/*}/called; test $4 = 1.1.0");
        let new = migration("gait", None, "1.1.0");
        assert_eq!(call(&path, "s1", &new).await, Ok(()));
        let other = migration("gait", Some("1.1.0"), "1.2.0");
        assert!(matches!(call(&path, "s1", &other).await, Err(Failure::Later(_))));
        let called = fs::read_to_string(folder.path().join("called")).expect("was called");
        assert_eq!(called, "s1 midshift-migrate gait - 1.1.0\ns1 midshift-migrate gait 1.1.0 1.2.0\n");
        assert!(matches!(call(&folder.path().join("none"), "s1", &new).await, Err(Failure::Later(_))));
    }
}
