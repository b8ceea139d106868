//! `midshift bundle ls` and `revoke`: bundles as the server has them, and who runs them.

use super::client::{Call, Change, Exit, WOULD, ended, unary};
use super::out::{Format, Out};
use super::pages::{self, PAGE_SIZE};
use midshift_proto::ota::v1;
use std::collections::BTreeMap;

/// Robots that keep a bundle, and robots that try it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Runs {
    /// They keep it.
    pub committed: u32,
    /// They try it.
    pub on_trial: u32,
}

/// Counts robots by the digest of what they run. One that tries a bundle is counted there and not at what it would go back to.
pub fn runs(software: &[v1::RobotSoftware]) -> BTreeMap<&str, Runs> {
    let mut runs: BTreeMap<&str, Runs> = BTreeMap::new();
    for robot in software {
        if !robot.on_trial.is_empty() {
            runs.entry(&robot.on_trial).or_default().on_trial += 1;
        } else if !robot.committed.is_empty() {
            runs.entry(&robot.committed).or_default().committed += 1;
        }
    }
    runs
}

/// Lists bundles.
pub async fn list(call: &Call, out: &Out) -> Result<(), Exit> {
    let mut client = call.bundles().await?;
    let request = |page_token| unary(v1::ListBundlesRequest { page_size: PAGE_SIZE, page_token });
    let mut whole = pages::all(async |page_token| client.list_bundles(request(page_token)).await).await?;
    // Which keys the server lacks is the doctor's to tell.
    whole.keyless = None;
    // Programs ask ListRobotSoftware themselves: the JSON is the answer about bundles and no more.
    let software = if out.format == Format::Table { software(call).await? } else { Vec::new() };
    let runs = runs(&software);
    let header = ["BUNDLE", "VERSION", "COMPONENTS", "BYTES", "ROBOTS", "PUBLISHED", "SHA-256"];
    let row = |b: &v1::Bundle| {
        let published = b.publish_time.map(|t| t.to_string()).unwrap_or_default();
        let (count, length) = (b.components.len().to_string(), b.length.to_string());
        let robots = robots(runs.get(b.digest.as_str()).copied().unwrap_or_default());
        vec![b.name.clone(), b.version.clone(), count, length, robots, published, b.digest.clone()]
    };
    out.many(&whole, &whole.bundles, |b| b.digest.clone(), &header, row)?;
    if out.format == Format::Table {
        out.inform(&room(&whole.room.unwrap_or_default()));
    }
    Ok(())
}

/// How full the server is, in words.
pub fn room(room: &v1::SoftwareRoom) -> String {
    let v1::SoftwareRoom { used_bytes, quota_bytes, encoded_bytes, unnamed_bytes, .. } = room;
    let mut text = format!("{used_bytes} of {quota_bytes} bytes are used");
    if *encoded_bytes > 0 {
        text += &format!(", {encoded_bytes} of them by shorter ways to files");
    }
    if *unnamed_bytes > 0 {
        text += &format!("; nothing names {unnamed_bytes} of them, and they will go");
    }
    text
}

fn robots(runs: Runs) -> String {
    let all = runs.committed + runs.on_trial;
    if runs.on_trial == 0 { all.to_string() } else { format!("{all} ({} on trial)", runs.on_trial) }
}

async fn software(call: &Call) -> Result<Vec<v1::RobotSoftware>, Exit> {
    let mut client = call.rollouts().await?;
    let request = |page_token| {
        let robot_id = String::new();
        unary(v1::ListRobotSoftwareRequest { robot_id, page_size: PAGE_SIZE, page_token })
    };
    Ok(pages::all(async |page_token| client.list_robot_software(request(page_token)).await).await?.software)
}

/// Takes a bundle back.
pub async fn revoke(call: &Call, bundle: String, reason: String, change: Change, out: &Out) -> Result<(), Exit> {
    let (only, Change { request_id, dry_run: validate_only }) = (change.only(), change);
    let request = v1::RevokeBundleRequest { bundle: bundle.clone(), reason, request_id, validate_only };
    let answer = call.rollouts().await?.revoke_bundle(unary(request)).await.map_err(Exit::with_facts)?.into_inner();
    if answer.done_before.is_some() {
        out.one(&answer, &answer.bundle, || format!("{bundle} was taken back before; {}", open(&answer)))?;
        ended(answer.done_before.as_ref(), only, "", out);
        return Ok(());
    }
    if validate_only {
        out.one(&answer, &answer.bundle, || format!("{bundle} would be taken back; then {}", open(&answer)))?;
        out.next(WOULD);
        return Ok(());
    }
    out.one(&answer, &answer.bundle, || format!("{bundle} is taken back: nobody gets it any more; {}", open(&answer)))?;
    match answer.rollout_ids.first() {
        Some(id) => out.next(&format!("midshift rollout abort {id}; then midshift bundle withdraw {bundle}")),
        None => out.next(&format!("midshift bundle withdraw {bundle} --repository REPOSITORY --key targets-1.pem")),
    }
    Ok(())
}

/// What becomes of the roll-outs of a revoked bundle, in words.
fn open(answer: &v1::RevokeBundleResponse) -> String {
    let told = |what: &str, ids: &[String]| (!ids.is_empty()).then(|| format!("{what}: {}", ids.join(" ")));
    let still = told("these roll-outs stand still", &answer.rollout_ids);
    let back = told("these go back already", &answer.reverting_rollout_ids);
    let all: Vec<String> = still.into_iter().chain(back).collect();
    if all.is_empty() { "no roll-out of it is open".to_owned() } else { all.join("; ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roll_outs_of_a_revoked_bundle_are_told_by_whether_they_stand_still_or_go_back() {
        let said = |still: &[&str], back: &[&str]| {
            let owned = |ids: &[&str]| ids.iter().map(|id| (*id).to_owned()).collect();
            let (rollout_ids, reverting_rollout_ids) = (owned(still), owned(back));
            open(&v1::RevokeBundleResponse {
                rollout_ids,
                reverting_rollout_ids,
                ..v1::RevokeBundleResponse::default()
            })
        };
        assert_eq!(said(&[], &[]), "no roll-out of it is open");
        assert_eq!(said(&["a"], &[]), "these roll-outs stand still: a");
        assert_eq!(said(&["a"], &["b", "c"]), "these roll-outs stand still: a; these go back already: b c");
    }

    #[test]
    fn a_robot_is_counted_at_the_bundle_that_it_runs_and_at_no_other() {
        let robot = |committed: &str, on_trial: &str| v1::RobotSoftware {
            committed: committed.to_owned(),
            on_trial: on_trial.to_owned(),
            ..v1::RobotSoftware::default()
        };
        let software = [robot("a", ""), robot("a", "b"), robot("b", ""), robot("", "b"), robot("", "")];
        let counted: Vec<_> = runs(&software).into_iter().map(|(id, runs)| (id, robots(runs))).collect();
        assert_eq!(counted, [("a", "1".to_owned()), ("b", "3 (2 on trial)".to_owned())]);
    }
}
