//! Downloads of robots without an end: as much as the machine carries over connections with the settings of a robot's downloads. Nothing of them is kept.
//!
//! Called by children only.

use crate::questions::answer_questions;
use anyhow::Context;
use midshift_agent::bulk::Bulk;
use midshift_agent::dial::TcpDial;
use midshift_agent::update::io::Remote;
use midshift_agent::update::remote::GrpcRemote;
use midshift_bundle::digest::Digest;
use midshift_core::limits;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use tokio::task::JoinSet;
use tokio_stream::StreamExt;
use tokio_util::sync::CancellationToken;

/// What to be.
#[derive(Clone, Debug, clap::Args)]
pub struct PullArgs {
    /// The server, host:port.
    #[arg(long)]
    server: String,
    /// The file.
    #[arg(long)]
    digest: String,
    /// Its bytes.
    #[arg(long)]
    length: u64,
    /// Downloads at once.
    #[arg(long)]
    downloads: usize,
}

/// Downloads until `stop`; each question is answered with the bytes so far.
pub async fn run(args: PullArgs, address: SocketAddr, stop: CancellationToken) -> anyhow::Result<()> {
    let digest: Digest = args.digest.parse().ok().context("no digest")?;
    let bytes = Arc::new(AtomicU64::new(0));
    let counted = bytes.clone();
    answer_questions(address, stop.clone(), move |_| counted.load(Relaxed))?;
    let mut all = JoinSet::new();
    for _ in 0..args.downloads {
        let dial = TcpDial::bulk(&midshift_cli::endpoint::uri(&args.server), None)?;
        let (remote, bytes) = (GrpcRemote::new(Bulk::new(Arc::new(dial))), bytes.clone());
        all.spawn(async move { again(&remote, &digest, args.length, &bytes).await });
    }
    tokio::select! {
        ended = all.join_next() => ended.context("no downloads")??,
        () = stop.cancelled() => Ok(()),
    }
}

async fn again(remote: &GrpcRemote, digest: &Digest, length: u64, bytes: &AtomicU64) -> anyhow::Result<()> {
    loop {
        for from in (0..length).step_by(usize::try_from(limits::CHUNK_RANGE_BYTES)?) {
            let mut pieces = remote.range(digest, from..length.min(from + limits::CHUNK_RANGE_BYTES)).await?;
            while let Some(piece) = pieces.next().await {
                bytes.fetch_add(piece?.len() as u64, Relaxed);
            }
        }
    }
}
