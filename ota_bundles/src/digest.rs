//! SHA-256 of content, as a type that cannot be a half one.

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use std::fmt;
use std::io::Read;
use std::str::FromStr;

/// Bytes read at a time.
const READ_BYTES: usize = 256 * 1024;

/// SHA-256 of some content. Written as 64 lower-case hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Digest([u8; 32]);

/// A digest in the making, of content that comes in pieces.
#[derive(Clone, Debug, Default)]
pub struct Hashing(Sha256);

impl Hashing {
    /// The next piece.
    pub fn update(&mut self, piece: &[u8]) {
        self.0.update(piece);
    }
    /// Of all pieces so far.
    pub fn digest(&self) -> Digest {
        Digest(self.0.clone().finalize().into())
    }
}

/// A text that is no digest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("must be 64 lower-case hexadecimal digits")]
pub struct BadDigest;

impl Digest {
    /// Of bytes in memory.
    pub fn of_content(content: &[u8]) -> Self {
        Self(Sha256::digest(content).into())
    }
    /// Of everything a reader gives, with the number of bytes; an error once there are more than `most`.
    ///
    /// # Errors
    /// The reader's, or `InvalidData` for too much.
    pub fn of_reader(reader: &mut dyn Read, most: u64) -> std::io::Result<(Self, u64)> {
        let mut hash = Hashing::default();
        let mut buffer = vec![0; READ_BYTES];
        let mut length = 0_u64;
        loop {
            let count = reader.read(&mut buffer)?;
            if count == 0 {
                return Ok((hash.digest(), length));
            }
            length += count as u64;
            if length > most {
                return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, format!("more than {most} bytes")));
            }
            hash.update(&buffer[..count]);
        }
    }
    /// The 32 bytes.
    pub fn bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl fmt::Display for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl fmt::Debug for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for Digest {
    type Err = BadDigest;
    fn from_str(text: &str) -> Result<Self, BadDigest> {
        let digit = |b: u8| match b {
            b'0'..=b'9' => Ok(b - b'0'),
            b'a'..=b'f' => Ok(b - b'a' + 10),
            _ => Err(BadDigest),
        };
        let pairs: Vec<u8> = text
            .as_bytes()
            .chunks(2)
            .map(|pair| match pair {
                [high, low] => Ok(digit(*high)? << 4 | digit(*low)?),
                _ => Err(BadDigest),
            })
            .collect::<Result<_, _>>()?;
        pairs.try_into().map(Self).map_err(|_| BadDigest)
    }
}

impl TryFrom<String> for Digest {
    type Error = BadDigest;
    fn try_from(text: String) -> Result<Self, BadDigest> {
        text.parse()
    }
}

impl From<Digest> for String {
    fn from(digest: Digest) -> Self {
        digest.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_digest_is_read_as_it_is_written_and_nothing_else_is() {
        let digest = Digest::of_content(b"abc");
        assert_eq!(digest.to_string(), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert_eq!(digest.to_string().parse(), Ok(digest));
        let text = digest.to_string();
        for bad in [&text[1..], &text.to_uppercase(), &format!("{text}00"), "", &text.replace('b', "é")] {
            assert_eq!(bad.parse::<Digest>(), Err(BadDigest), "{bad}");
        }
    }

    #[test]
    fn a_reader_is_hashed_to_its_end_and_not_beyond_its_limit() {
        let content = vec![7; READ_BYTES * 2 + 3];
        let found = Digest::of_reader(&mut content.as_slice(), content.len() as u64).expect("within the limit");
        assert_eq!(found, (Digest::of_content(&content), content.len() as u64));
        assert!(Digest::of_reader(&mut content.as_slice(), content.len() as u64 - 1).is_err());
    }
}
