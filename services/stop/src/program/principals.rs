//! Who is known at the port of the stop service, as whoever has the store writes it down beside the latch.
//!
//! Invariant: what cannot be read changes nothing; the last that could stays in force.

use super::next::UP_WITHIN;
use crate::port::{self, Followed};
use crate::snapshot::Principals;
use anyhow::{Context, bail};
use midshift_core::identity::ServerProof;
use midshift_core::site::Site;
use midshift_core::time::Clock;
use midshift_edge::Denials;
use midshift_process::door::Login;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// How often it is looked whether anybody has written it at all.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How often it is looked whether somebody else is known: with the writer's own second, two after a revocation at the latest.
const PRINCIPALS_EVERY: Duration = Duration::from_millis(500);

/// Who is known, as whoever has the store wrote it down beside the latch; followed from then on.
pub async fn follow(folder: &Path, site: &Site, clock: &Arc<dyn Clock>) -> anyhow::Result<Followed> {
    let mut waited = Duration::ZERO;
    let first = loop {
        match Principals::read(folder) {
            Ok(Some(principals)) => break principals,
            Err(error) => return Err(error).context("reading who is known"),
            Ok(None) if waited >= UP_WITHIN => bail!(
                "{} says not who is known: start `midshift serve` on the same data folder first, or its role stop-follower beside this",
                folder.join(Principals::NAME).display()
            ),
            Ok(None) => {}
        }
        tokio::time::sleep(LOOK_EVERY).await;
        waited += LOOK_EVERY;
    };
    let (directory, proof) =
        (watch::Sender::new(Arc::new(first.directory.clone())), watch::Sender::new(proof_of(&first)));
    let (denials, told) = Denials::new(port::NAME);
    let login = Login {
        site_id: site.site_id().clone(),
        clock: clock.clone(),
        directory: directory.subscribe(),
        proof: proof.subscribe(),
        denials,
    };
    let (folder, mut last) = (folder.to_owned(), first);
    let said = watch::Sender::new(Principals::written_at(&folder).unwrap_or_default());
    let (followed, mut is_readable) = (said.subscribe(), true);
    // As long as the port is open: it ends with the receivers.
    tokio::spawn(async move {
        while !directory.is_closed() {
            tokio::time::sleep(PRINCIPALS_EVERY).await;
            let read = Principals::read(&folder);
            if let (Ok(Some(_)), Some(told)) = (&read, Principals::written_at(&folder)) {
                said.send_replace(told);
            }
            match read {
                Ok(Some(newest)) if newest != last => {
                    proof.send_replace(proof_of(&newest));
                    directory.send_replace(Arc::new(newest.directory.clone()));
                    last = newest;
                }
                Ok(_) => is_readable = true,
                // Once, and not twice a second.
                Err(error) => {
                    if std::mem::take(&mut is_readable) {
                        tracing::warn!(%error, "who is known cannot be read; the last that could stays in force");
                    }
                }
            }
        }
    });
    Ok((login, told, followed))
}

fn proof_of(principals: &Principals) -> ServerProof {
    let Principals { chain_pem, key_pem, authority_pem, .. } = principals.clone();
    ServerProof { chain_pem, key_pem, authority_pem }
}
