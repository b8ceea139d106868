//! Messages on the wire, with first buffers for the thousands of streams that are quiet most of the time.
//!
//! Invariant: buffers grow when they must: nothing is refused for its size here. Generated code and the lines of robots use it.

use prost::Message;
use std::marker::PhantomData;
use tonic::codec::{BufferSettings, Codec};
use tonic_prost::{ProstDecoder, ProstEncoder};

/// Bytes of a stream's buffer each way at first, and from which on what was encoded is handed on.
const BUFFER_BYTES: (usize, usize) = (512, 32 * 1024);

/// How large buffers are at first.
pub fn small_buffers() -> BufferSettings {
    BufferSettings::new(BUFFER_BYTES.0, BUFFER_BYTES.1)
}

/// Sends `E` and receives `D`.
#[derive(Debug)]
pub struct SmallCodec<E, D>(PhantomData<(E, D)>);

impl<E, D> Default for SmallCodec<E, D> {
    fn default() -> Self {
        Self(PhantomData)
    }
}

impl<E: Message + Send + 'static, D: Message + Default + Send + 'static> Codec for SmallCodec<E, D> {
    type Encode = E;
    type Decode = D;
    type Encoder = ProstEncoder<E>;
    type Decoder = ProstDecoder<D>;

    fn encoder(&mut self) -> Self::Encoder {
        ProstEncoder::new(small_buffers())
    }
    fn decoder(&mut self) -> Self::Decoder {
        ProstDecoder::new(small_buffers())
    }
}
