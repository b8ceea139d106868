//! How the frames of one group lie in one `frame_log` row: each as its robot, ring, first and last number and bytes.
//!
//! Invariant: `unpack(pack(frames)) == frames`; a row cut short or garbled is an error, never a shorter answer.
//! Layout, all little-endian: u8 length and robot_id, u8 length and ring, u64 first, u64 last, u32 length and bytes.

use crate::{Coarsen, Frame};
use midshift_core::ids::RobotId;
use std::sync::Arc;

/// A `frame_log` row that cannot be read, or a frame that cannot be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("frame_log row: {0}")]
pub(crate) struct BadFrames(&'static str);

pub(crate) fn pack(frame: &Frame, out: &mut Vec<u8>) -> Result<(), BadFrames> {
    for text in [frame.robot_id.as_str(), &frame.ring] {
        out.push(u8::try_from(text.len()).map_err(|_| BadFrames("ring is longer than 255 bytes"))?);
        out.extend(text.as_bytes());
    }
    out.extend(frame.first_seq.to_le_bytes());
    out.extend(frame.last_seq.to_le_bytes());
    let length = u32::try_from(frame.bytes.len()).map_err(|_| BadFrames("frame is longer than 4 GiB"))?;
    out.extend(length.to_le_bytes());
    out.extend(frame.bytes.iter());
    Ok(())
}

/// A row as it is once `coarsen` was let at each of its frames. A frame that cannot be read is left without its samples, and its numbers stay.
pub(crate) fn coarser(body: &[u8], coarsen: Coarsen) -> Result<Vec<u8>, BadFrames> {
    let mut out = Vec::with_capacity(body.len());
    for frame in unpack(body)? {
        let bytes = coarsen(&frame.bytes).unwrap_or_else(|| {
            tracing::error!(robot_id = %frame.robot_id, first_seq = frame.first_seq, last_seq = frame.last_seq, "samples cannot be read and were taken out");
            Vec::new()
        });
        pack(&Frame { bytes: Arc::from(bytes), ..frame }, &mut out)?;
    }
    Ok(out)
}

pub(crate) fn unpack(mut rest: &[u8]) -> Result<Vec<Frame>, BadFrames> {
    let mut frames = Vec::new();
    while !rest.is_empty() {
        let robot_id = RobotId::parse(text(&mut rest)?).map_err(|_| BadFrames("not a robot_id"))?;
        let ring = Arc::from(text(&mut rest)?);
        let first_seq = u64::from_le_bytes(fixed(&mut rest)?);
        let last_seq = u64::from_le_bytes(fixed(&mut rest)?);
        let length = u32::from_le_bytes(fixed(&mut rest)?);
        let bytes = Arc::from(bytes(&mut rest, length as usize)?);
        frames.push(Frame { robot_id, ring, first_seq, last_seq, bytes });
    }
    Ok(frames)
}

fn bytes<'a>(rest: &mut &'a [u8], length: usize) -> Result<&'a [u8], BadFrames> {
    let (taken, left) = rest.split_at_checked(length).ok_or(BadFrames("cut short"))?;
    *rest = left;
    Ok(taken)
}

fn fixed<const N: usize>(rest: &mut &[u8]) -> Result<[u8; N], BadFrames> {
    bytes(rest, N)?.try_into().map_err(|_| BadFrames("cut short"))
}

fn text<'a>(rest: &mut &'a [u8]) -> Result<&'a str, BadFrames> {
    let [length] = fixed(rest)?;
    std::str::from_utf8(bytes(rest, usize::from(length))?).map_err(|_| BadFrames("text is not UTF-8"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_read_back_as_written_and_a_row_cut_anywhere_but_between_two_is_an_error() {
        let frame = |robot: &str, first_seq| Frame {
            robot_id: RobotId::parse(robot).expect("a robot id"),
            ring: Arc::from("ring-7"),
            first_seq,
            last_seq: first_seq + 2,
            bytes: Arc::from(&b"samples"[..]),
        };
        let frames = vec![frame("a", 1), frame("rbt-02", 900)];
        let mut packed = Vec::new();
        pack(&frames[0], &mut packed).expect("a short frame");
        let first_length = packed.len();
        pack(&frames[1], &mut packed).expect("a short frame");
        assert_eq!(unpack(&packed), Ok(frames));
        for cut in (1..packed.len()).filter(|cut| *cut != first_length) {
            assert!(unpack(&packed[..cut]).is_err(), "cut at {cut}");
        }
    }
}
