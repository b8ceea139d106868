//! A stop whose answer is swallowed on its way: it is asked for again, and is one stop; whoever does not wait is told in time that nobody knows.

use crate::harness::{folder, free_port, same_site};
use crate::rolled_out::call;
use crate::stop_alone::{stop_service, way};
use anyhow::ensure;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;

/// The frame of HTTP/2 that begins an answer.
const HEADERS: u8 = 1;

/// Passes on what the server says, frame by frame; if it `swallows` answers, then nothing more once one begins.
async fn carry(mut from: OwnedReadHalf, mut to: OwnedWriteHalf, swallows: bool) -> io::Result<()> {
    loop {
        let mut frame = vec![0; 9];
        from.read_exact(&mut frame).await?;
        let bytes = u32::from_be_bytes([0, frame[0], frame[1], frame[2]]) as usize;
        frame.resize(9 + bytes, 0);
        from.read_exact(&mut frame[9..]).await?;
        if swallows && frame[3] == HEADERS {
            return std::future::pending().await;
        }
        to.write_all(&frame).await?;
    }
}

/// Stands before `server` and swallows each answer to the first connection. How many connections came.
async fn swallows(listener: TcpListener, server: SocketAddr, came: Arc<AtomicUsize>) -> io::Result<()> {
    let mut ways = JoinSet::new();
    loop {
        let (client, _) = listener.accept().await?;
        let (mut said, client) = client.into_split();
        let (server, mut to) = TcpStream::connect(server).await?.into_split();
        let is_first = came.fetch_add(1, Ordering::Relaxed) == 0;
        ways.spawn(async move { tokio::io::copy(&mut said, &mut to).await.map(drop) });
        ways.spawn(carry(server, client, is_first));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_whose_answer_is_swallowed_is_asked_for_again_and_is_one_stop() -> anyhow::Result<()> {
    let (dir, address) = (folder()?, free_port()?);
    let (_running, _children) = stop_service(dir.path(), address)?;
    let mut people = StopServiceClient::new(way(address).await?);
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let between = listener.local_addr()?;
    same_site(address, between)?;
    let came = Arc::new(AtomicUsize::new(0));
    let mut relay = JoinSet::new();
    relay.spawn(swallows(listener, address, came.clone()));
    let at = between.to_string();
    let engage = ["stop", "--all", "--stop-server", &at, "--reason", "drill"];
    let heard = tokio::task::block_in_place(|| call(&engage))?;
    let said = String::from_utf8_lossy(&heard.stderr).into_owned();
    ensure!(heard.status.code() == Some(13) && said.contains("it is asked again, for the same stop"), "{said}");
    ensure!(came.load(Ordering::Relaxed) == 2, "{came:?} connections came");
    let status = people.get_status(v1::GetStatusRequest {}).await?.into_inner().status.unwrap_or_default();
    let drills = status.stops.iter().filter_map(|engaged| engaged.stop.as_ref()).filter(|stop| stop.reason == "drill");
    ensure!(drills.count() == 1, "{status:?}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_does_not_wait_is_told_that_nobody_knows_when_nothing_is_answered() -> anyhow::Result<()> {
    let silent = TcpListener::bind("127.0.0.1:0").await?;
    let at = silent.local_addr()?.to_string();
    let heard = tokio::task::block_in_place(|| {
        call(&["stop", "--all", "--stop-server", &at, "--reason", "drill", "--no-wait"])
    })?;
    let said = String::from_utf8_lossy(&heard.stderr).into_owned();
    ensure!(heard.status.code() == Some(10) && said.contains("nobody knows whether the stop is engaged"), "{said}");
    Ok(())
}
