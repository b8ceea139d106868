//! Encodings that make a file shorter on a network: zstd, and zstd against another file that the robot has (a patch).
//!
//! A file is cut into segments of [`SEGMENT_BYTES`]; each is one zstd frame with its length and check. In a patch a segment may point into
//! the other file, [`REACH_BYTES`] before and after its own place: bytes that moved farther come again. So nobody holds more than
//! 128 MiB (2^[`WINDOW_LOG`]) of content in memory, however long the file. A patch of one segment is what `zstd --patch-from` writes, and
//! a file without a patch is one that `zstd -d` reads.
//! Invariant: what comes out is believed by nobody before its digest is. Called by whoever signs a release to write, and by robots to read.

use crate::digest::{Digest, Hashing};
use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};
use zstd::stream::read::Decoder;
use zstd::stream::write::Encoder;

/// Bytes of the file in one frame.
pub const SEGMENT_BYTES: u64 = 32 * 1024 * 1024;
/// How far before and after its own place a segment points into the other file, bytes.
pub const REACH_BYTES: u64 = 32 * 1024 * 1024;
/// Logarithm of the bytes that a frame may look back, its segment and what it points into: the memory of whoever reads it.
pub const WINDOW_LOG: u32 = 27;
/// A shorter file is fetched as it is: asking costs as much, bytes.
pub const ENCODED_BYTES_MIN: u64 = 16 * 1024;
/// A longer file is fetched as it is: making it shorter would hold up who signs for minutes, bytes.
pub const ENCODED_BYTES_MAX: u64 = 1024 * 1024 * 1024;
/// Effort of the writer: of 1..22 the last before zstd becomes slow.
const LEVEL: i32 = 9;

/// A file that can be read from any place.
pub trait Base: Read + Seek + Send {}

impl<T: Read + Seek + Send> Base for T {}

/// What was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Encoded {
    /// Of its bytes.
    pub digest: Digest,
    /// How many bytes it has.
    pub length: u64,
}

/// How a file is cut.
#[derive(Clone, Copy)]
struct Cut {
    segment: u64,
    reach: u64,
}

const CUT: Cut = Cut { segment: SEGMENT_BYTES, reach: REACH_BYTES };

/// Counts and hashes what is written, and stops at `most`.
struct Counted<'a> {
    out: &'a mut dyn Write,
    hash: Hashing,
    length: u64,
    most: u64,
}

impl Write for Counted<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.length + bytes.len() as u64 > self.most {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        let count = self.out.write(bytes)?;
        self.hash.update(&bytes[..count]);
        self.length += count as u64;
        Ok(count)
    }
    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// Writes the `length` bytes of `file` shorter, against `base` if there is one. None: it would take more than `most` bytes.
///
/// # Errors
/// The readers', the writer's, or `UnexpectedEof` for a file that ends early.
pub fn encode(
    base: Option<&mut dyn Base>,
    file: &mut dyn Read,
    length: u64,
    out: &mut dyn Write,
    most: u64,
) -> io::Result<Option<Encoded>> {
    encode_cut(CUT, base, file, length, out, most)
}

/// Reads what [`encode`] wrote against the same `base`: exactly `length` bytes go to `out`, never more.
///
/// # Errors
/// The readers' and the writer's; `InvalidData` or another of zstd's for bytes that are not of this file.
pub fn decode(base: Option<&mut dyn Base>, encoded: &mut dyn Read, length: u64, out: &mut dyn Write) -> io::Result<()> {
    decode_cut(CUT, base, encoded, length, out)
}

fn encode_cut(
    cut: Cut,
    mut base: Option<&mut dyn Base>,
    file: &mut dyn Read,
    length: u64,
    out: &mut dyn Write,
    most: u64,
) -> io::Result<Option<Encoded>> {
    let mut counted = Counted { out, hash: Hashing::default(), length: 0, most };
    let mut at = 0;
    while at < length {
        let segment = cut.segment.min(length - at);
        let prefix = prefix(cut, base.as_deref_mut(), at, segment)?;
        match encode_segment(&prefix, file, segment, &mut counted) {
            Err(error) if error.kind() == io::ErrorKind::FileTooLarge => return Ok(None),
            result => result?,
        }
        at += segment;
    }
    counted.flush()?;
    Ok(Some(Encoded { digest: counted.hash.digest(), length: counted.length }))
}

fn encode_segment(prefix: &[u8], file: &mut dyn Read, segment: u64, out: &mut Counted<'_>) -> io::Result<()> {
    let mut encoder = Encoder::with_ref_prefix(out, LEVEL, prefix)?;
    encoder.set_pledged_src_size(Some(segment))?;
    encoder.include_checksum(true)?;
    encoder.window_log(WINDOW_LOG)?;
    encoder.long_distance_matching(true)?;
    if io::copy(&mut file.take(segment), &mut encoder)? != segment {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    encoder.finish().map(|_| ())
}

fn decode_cut(
    cut: Cut,
    mut base: Option<&mut dyn Base>,
    encoded: &mut dyn Read,
    length: u64,
    out: &mut dyn Write,
) -> io::Result<()> {
    let wrong = |what: &str| io::Error::new(io::ErrorKind::InvalidData, what);
    let mut encoded = BufReader::new(encoded);
    let mut at = 0;
    while at < length {
        let segment = cut.segment.min(length - at);
        let prefix = prefix(cut, base.as_deref_mut(), at, segment)?;
        let mut decoder = Decoder::with_ref_prefix(&mut encoded, &prefix)?.single_frame();
        decoder.window_log_max(WINDOW_LOG)?;
        if io::copy(&mut (&mut decoder).take(segment), out)? != segment {
            return Err(wrong("a segment ends early"));
        }
        // The frame's check stands behind its last byte: it is read with the end.
        if decoder.read(&mut [0])? != 0 {
            return Err(wrong("a segment is longer than it should be"));
        }
        at += segment;
    }
    if encoded.read(&mut [0])? == 0 { Ok(()) } else { Err(wrong("something follows the last segment")) }
}

/// What a segment may point into.
fn prefix(cut: Cut, base: Option<&mut (dyn Base + '_)>, at: u64, segment: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    if let Some(base) = base {
        let from = at.saturating_sub(cut.reach);
        base.seek(SeekFrom::Start(from))?;
        base.take(at + segment + cut.reach - from).read_to_end(&mut bytes)?;
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    const SMALL: Cut = Cut { segment: 100_000, reach: 60_000 };

    /// Bytes that do not become shorter by themselves.
    fn noise(seed: u64, length: usize) -> Vec<u8> {
        let mut state = seed;
        let step = |_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as u8
        };
        (0..length).map(step).collect()
    }

    /// A program and the next one: something was put in, something taken out, something changed.
    fn programs() -> (Vec<u8>, Vec<u8>) {
        let old = noise(1, 450_000);
        let mut new = old.clone();
        new.splice(50_000..50_000, noise(2, 5_000));
        new.drain(200_000..220_000);
        new[300_000..300_040].copy_from_slice(&noise(3, 40));
        (old, new)
    }

    fn made(cut: Cut, base: Option<&[u8]>, file: &[u8]) -> Vec<u8> {
        let (mut out, mut base) = (Vec::new(), base.map(Cursor::new));
        let base = base.as_mut().map(|b| b as &mut dyn Base);
        let encoded = encode_cut(cut, base, &mut &*file, file.len() as u64, &mut out, u64::MAX).expect("writes");
        assert_eq!(encoded, Some(Encoded { digest: Digest::of_content(&out), length: out.len() as u64 }));
        out
    }

    fn read(cut: Cut, base: Option<&[u8]>, encoded: &[u8], length: usize) -> (Vec<u8>, bool) {
        let (mut out, mut base) = (Vec::new(), base.map(Cursor::new));
        let base = base.as_mut().map(|b| b as &mut dyn Base);
        let result = decode_cut(cut, base, &mut &*encoded, length as u64, &mut out);
        assert!(out.len() <= length, "never more than was asked for");
        (out, result.is_ok())
    }

    #[test]
    fn a_patch_of_moved_content_is_small_and_gives_the_file_back_and_the_same_bytes_each_time() {
        let (old, new) = programs();
        for cut in [SMALL, CUT] {
            let patch = made(cut, Some(&old), &new);
            assert!(patch.len() < new.len() / 20, "{} of {}", patch.len(), new.len());
            assert_eq!(read(cut, Some(&old), &patch, new.len()), (new.clone(), true));
            assert_eq!(made(cut, Some(&old), &new), patch);
        }
    }

    #[test]
    fn without_another_file_it_is_plain_zstd() {
        let file = b"settings of a robot that walks ".repeat(9_000);
        let encoded = made(SMALL, None, &file);
        assert!(encoded.len() < file.len() / 100);
        assert_eq!(read(SMALL, None, &encoded, file.len()), (file.clone(), true));
        assert_eq!(zstd::decode_all(&*encoded).expect("any zstd reads it"), file);
    }

    #[test]
    fn files_of_any_length_beside_a_base_of_any_length_come_back() {
        let lengths = [1, 99_999, 100_000, 100_001, 200_000];
        for base in [0, 1, 70_000, 500_000] {
            for length in lengths {
                let (base, file) = (noise(1, base), noise(1, length));
                let encoded = made(SMALL, Some(&base), &file);
                assert_eq!(read(SMALL, Some(&base), &encoded, length), (file, true), "{length} of {}", base.len());
            }
        }
    }

    #[test]
    fn what_would_be_too_long_is_given_up() {
        let file = noise(1, 300_000);
        let mut out = Vec::new();
        let given_up = encode_cut(SMALL, None, &mut &*file, file.len() as u64, &mut out, 250_000).expect("writes");
        assert_eq!(given_up, None);
        assert!(out.len() <= 250_000);
        assert!(encode_cut(SMALL, None, &mut &*file, file.len() as u64 + 1, &mut out, u64::MAX).is_err());
    }

    #[test]
    fn changed_cut_or_added_bytes_and_another_base_do_not_go_through() {
        let (old, new) = programs();
        let patch = made(SMALL, Some(&old), &new);
        for at in (0..patch.len()).step_by(97) {
            let mut changed = patch.clone();
            changed[at] ^= 0x10;
            assert_ne!(read(SMALL, Some(&old), &changed, new.len()), (new.clone(), true), "byte {at}");
            assert!(!read(SMALL, Some(&old), &patch[..at], new.len()).1, "cut at {at}");
        }
        assert!(!read(SMALL, Some(&old), &[&patch[..], b"x"].concat(), new.len()).1);
        assert!(!read(SMALL, Some(&noise(9, old.len())), &patch, new.len()).1);
        assert!(!read(SMALL, None, &patch, new.len()).1);
    }

    #[test]
    fn a_length_that_is_a_lie_and_a_bomb_stop_at_the_length_that_was_asked_for() {
        let (old, new) = programs();
        let patch = made(SMALL, Some(&old), &new);
        for length in [0, 1, 99_999, new.len() - 1, new.len() + 1] {
            assert!(!read(SMALL, Some(&old), &patch, length).1, "{length}");
        }
        let bomb = zstd::encode_all(io::repeat(0).take(1 << 28), 3).expect("a bomb");
        assert!(bomb.len() < 64 * 1024);
        assert_eq!(read(SMALL, None, &bomb, 5_000), (vec![0; 5_000], false));
    }

    #[test]
    fn a_frame_that_wants_more_memory_than_there_is_for_it_is_refused() {
        let mut encoder = Encoder::new(Vec::new(), 1).expect("an encoder");
        encoder.window_log(WINDOW_LOG + 1).expect("a window");
        encoder.write_all(&noise(1, 1_000)).expect("writes");
        let wide = encoder.finish().expect("ends");
        assert!(!read(CUT, None, &wide, 1_000).1);
    }
}
