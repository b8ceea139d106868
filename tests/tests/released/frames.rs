//! What robots and servers of each release said to each other, read by this build.

use anyhow::{Context, bail, ensure};
use midshift_proto::link::v1 as link;
use midshift_proto::ota::v1 as ota;
use midshift_proto::session::{FromRobot, LaneAck, StatusReplay, ToRobot};
use midshift_proto::{Parse, parse};
use midshift_tests::released::Release;
use midshift_tests::wire::Frame;
use prost::Message;
use std::collections::BTreeSet;

/// Kinds of messages that a run's frames have: field paths, as [`Frame::parts`] names them.
pub const KINDS: &[&str] = &[
    ".hello",
    ".hello.previous",
    ".hello.reported.attempts",
    ".hello.installed",
    ".uplink.heartbeat",
    ".uplink.batches",
    ".welcome",
    ".downlink.echo",
    ".downlink.acks",
    ".downlink.work.assignment",
    ".downlink.policy",
    ".downlink.update.directive",
    ".downlink.update.grant",
    ".moveOver",
    ".close",
];

/// A message as it is, decoded and encoded.
fn again<M: Message + Default>(bytes: &[u8]) -> anyhow::Result<Vec<u8>> {
    Ok(M::decode(bytes)?.encode_to_vec())
}

/// The same by way of what services and agents work with.
fn through<M: Message + Default + Parse<T> + for<'a> From<&'a T>, T>(bytes: &[u8]) -> anyhow::Result<Vec<u8>> {
    let ours: T = parse(M::decode(bytes)?).map_err(|refusal| anyhow::anyhow!("{refusal}"))?;
    Ok(M::from(&ours).encode_to_vec())
}

/// Reads a frame as its receiver does; an error says what would be lost.
pub fn hold(frame: &Frame) -> anyhow::Result<()> {
    let bytes = frame.bytes.as_slice();
    let message = frame.message()?;
    let back = match message.full_name() {
        "midshift.link.v1.SessionRequest" => through::<link::SessionRequest, FromRobot>(bytes),
        "midshift.link.v1.SessionResponse" => through::<link::SessionResponse, ToRobot>(bytes),
        "midshift.link.v1.ReplayStatusRequest" => through::<link::ReplayStatusRequest, StatusReplay>(bytes),
        "midshift.link.v1.ReplayStatusResponse" => through::<link::ReplayStatusResponse, LaneAck>(bytes),
        "midshift.ota.v1.GetMetadataRequest" => again::<ota::GetMetadataRequest>(bytes),
        "midshift.ota.v1.GetMetadataResponse" => again::<ota::GetMetadataResponse>(bytes),
        "midshift.ota.v1.GetEncodingRequest" => again::<ota::GetEncodingRequest>(bytes),
        "midshift.ota.v1.GetEncodingResponse" => again::<ota::GetEncodingResponse>(bytes),
        "midshift.ota.v1.FetchChunksRequest" => again::<ota::FetchChunksRequest>(bytes),
        "midshift.ota.v1.FetchChunksResponse" => again::<ota::FetchChunksResponse>(bytes),
        other => bail!("{other} is not read here: add it"),
    };
    ensure!(back? == bytes, "{} has lost something: {:?}", message.full_name(), frame.parts()?);
    Ok(())
}

/// Whether frames of every kind are among them.
pub fn whole(frames: &[Frame]) -> anyhow::Result<()> {
    let mut parts = BTreeSet::new();
    for frame in frames {
        parts.extend(frame.parts()?);
    }
    let missing: Vec<_> = KINDS.iter().filter(|kind| !parts.contains(**kind)).collect();
    ensure!(missing.is_empty(), "no frame has {missing:?}");
    let said = |path: &str| frames.iter().any(|frame| frame.path.ends_with(path));
    // Two calls are not in a run: a shorter way (GetEncoding) is asked for files of 16 KiB and more, and those of a run are small; old STATUS
    // goes by ReplayStatus if there is more than 16 of it, which is half a minute of silence. `buf breaking` holds their messages.
    for path in ["/Session", "/GetMetadata", "/FetchChunks"] {
        ensure!(said(path), "nobody called {path}");
    }
    Ok(())
}

#[test]
fn every_frame_of_a_release_is_read_and_loses_nothing() -> anyhow::Result<()> {
    for release in Release::all()? {
        let text = release.text("wire.txt")?;
        let frames = text.lines().map(Frame::parse).collect::<anyhow::Result<Vec<_>>>()?;
        for (frame, number) in frames.iter().zip(1..) {
            hold(frame).with_context(|| format!("{}/wire.txt:{number}", release.folder.display()))?;
        }
        ensure!(!frames.is_empty(), "{} has no frames", release.folder.display());
    }
    Ok(())
}

#[test]
fn a_field_that_this_build_does_not_know_is_found_to_be_lost() -> anyhow::Result<()> {
    let mut bytes = ota::GetMetadataRequest { name: "timestamp.json".to_owned() }.encode_to_vec();
    let path = "/midshift.ota.v1.BundleService/GetMetadata".to_owned();
    hold(&Frame { path: path.clone(), is_up: true, bytes: bytes.clone() })?;
    // Field 100, the number 1.
    bytes.extend([0xa0, 0x06, 0x01]);
    assert!(hold(&Frame { path, is_up: true, bytes }).is_err());
    Ok(())
}
