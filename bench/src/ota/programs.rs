//! A pair of releases of a made-up program, from a seed: the same functions linked twice, with some of them changed between.
//!
//! It stands in for two builds where there are none: as in a real program a function that becomes longer moves all that follow, and every call over
//! it then has another distance. It is no measurement of a real pair; that is what `--pair` is for. Called by [`super::device`].

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Functions of the program.
const FUNCTIONS: usize = 24_000;
/// Instructions of one: fewest, and one more than most.
const LENGTH: std::ops::Range<usize> = 20..260;
/// Different instructions that are common, as bytes; the rest of a program is rare ones.
const COMMON: usize = 400;
/// Of a hundred instructions so many are common ones, and so many calls.
const COMMON_PERCENT: u32 = 82;
const CALL_PERCENT: u32 = 8;
/// Of a thousand functions so many are changed by a patch release; a quarter of them become longer.
pub const CHANGED_PERMILLE: u32 = 10;

/// One instruction before it is linked.
#[derive(Clone)]
enum Word {
    Bytes(Vec<u8>),
    /// Of another function: an opcode and the distance to it.
    Call(usize),
}

type Function = Vec<Word>;

struct Author {
    rng: ChaCha8Rng,
    common: Vec<Vec<u8>>,
}

impl Author {
    fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let common = (0..COMMON).map(|_| bytes(&mut rng)).collect();
        Self { rng, common }
    }
    fn word(&mut self) -> Word {
        match self.rng.random_range(0..100) {
            n if n < CALL_PERCENT => Word::Call(self.rng.random_range(0..FUNCTIONS)),
            n if n < CALL_PERCENT + COMMON_PERCENT => {
                // The commonest first: the smaller of two draws.
                let (one, other) = (self.rng.random_range(0..COMMON), self.rng.random_range(0..COMMON));
                Word::Bytes(self.common[one.min(other)].clone())
            }
            _ => Word::Bytes(bytes(&mut self.rng)),
        }
    }
    fn function(&mut self) -> Function {
        let length = self.rng.random_range(LENGTH);
        (0..length).map(|_| self.word()).collect()
    }
    /// The next release's: a few instructions are others, and sometimes some come in between.
    fn change(&mut self, function: &mut Function) {
        for _ in 0..3 {
            let at = self.rng.random_range(0..function.len());
            function[at] = self.word();
        }
        if self.rng.random_range(0..4) == 0 {
            let at = self.rng.random_range(0..function.len());
            let more: Function = (0..12).map(|_| self.word()).collect();
            function.splice(at..at, more);
        }
    }
}

fn bytes(rng: &mut ChaCha8Rng) -> Vec<u8> {
    let length = rng.random_range(2..8);
    (0..length).map(|_| rng.random()).collect()
}

/// Bytes of a call: an opcode and a distance.
const CALL_BYTES: usize = 5;

fn link(functions: &[Function]) -> Vec<u8> {
    let length = |word: &Word| match word {
        Word::Bytes(bytes) => bytes.len(),
        Word::Call(_) => CALL_BYTES,
    };
    let mut starts = Vec::new();
    let mut end = 0usize;
    for function in functions {
        starts.push(end);
        end = (end + function.iter().map(length).sum::<usize>()).next_multiple_of(16);
    }
    let mut program = Vec::with_capacity(end);
    for (function, start) in functions.iter().zip(&starts) {
        program.resize(*start, 0x90);
        for word in function {
            match word {
                Word::Bytes(bytes) => program.extend_from_slice(bytes),
                Word::Call(to) => {
                    let distance = starts[*to] as i64 - (program.len() + CALL_BYTES) as i64;
                    program.push(0xe8);
                    program.extend_from_slice(&(distance as i32).to_le_bytes());
                }
            }
        }
    }
    program
}

/// A program and its next patch release.
pub fn pair(seed: u64) -> (Vec<u8>, Vec<u8>) {
    let mut author = Author::new(seed);
    let mut functions: Vec<Function> = (0..FUNCTIONS).map(|_| author.function()).collect();
    let old = link(&functions);
    for function in &mut functions {
        if author.rng.random_range(0..1_000) < CHANGED_PERMILLE {
            author.change(function);
        }
    }
    (old, link(&functions))
}
