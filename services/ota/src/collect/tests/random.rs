//! Anything in any order, from seeds: what is listed or named can be fetched, no more than the quota is used, and in the end nothing else is
//! left.

use super::*;

const QUOTA: u64 = 16_000;

/// Numbers from a seed.
struct Dice(u64);

impl Dice {
    fn below(&mut self, most: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % most
    }
    fn some<'a>(&mut self, of: &[&'a Bundle]) -> Vec<&'a Bundle> {
        of.iter().filter(|_| self.below(2) == 0).copied().collect()
    }
}

/// Bundles of a line of releases: each has a program of its own, and a map that two of them share.
fn line() -> Vec<Bundle> {
    let bundle = |n: usize| {
        let (map, program) = (vec![n as u8 / 2; 1_500], vec![100 + n as u8; 700 + 300 * n]);
        with(&format!("{n}.0.0"), &[(&format!("map-{}", n / 2), &map), (&format!("program-{n}"), &program)])
    };
    (0..6).map(bundle).collect()
}

fn files<'a>(bundles: impl IntoIterator<Item = &'a Bundle>) -> BTreeSet<Digest> {
    bundles.into_iter().flat_map(|(_, files)| files.iter()).map(|(_, content)| Digest::of_content(content)).collect()
}

struct Run<'a> {
    shop: Shop,
    dice: Dice,
    line: &'a [Bundle],
    listed: Vec<&'a Bundle>,
    /// Named while they could be had, and ever since.
    needed: Vec<&'a Bundle>,
    refused: usize,
}

impl<'a> Run<'a> {
    /// Brings all of a file or only its beginning, from where it is.
    async fn bring(&mut self, content: &[u8]) {
        let file = wanted(content);
        let Completeness::Part(from) = self.shop.content.settle(file).await.expect("asked") else { return };
        let end = if self.dice.below(8) == 0 { content.len() / 2 } else { content.len() };
        let piece = Bytes::copy_from_slice(&content[(from as usize).min(end)..end]);
        match self.shop.content.append(file, from, piece).await {
            Ok(()) => drop(self.shop.content.settle(file).await.expect("its bytes")),
            Err(Error::Full { missing, used, free, quota }) => {
                assert_eq!((used + free, quota, missing), (QUOTA, QUOTA, file.length - from));
                let path = self.shop.dir.path().join("content").join(format!("{}.part", file.digest));
                assert_eq!(path.exists(), from > 0, "nothing is left of what never began");
                self.refused += 1;
            }
            Err(error) => panic!("{error}"),
        }
    }

    async fn is_whole(&self, bundle: &Bundle) -> bool {
        for (_, content) in &bundle.1 {
            if !self.shop.has(content).await {
                return false;
            }
        }
        true
    }

    async fn act(mut self) -> Self {
        let all: Vec<&'a Bundle> = self.line.iter().collect();
        match self.dice.below(10) {
            0..=2 => {
                let bundle = all[self.dice.below(all.len())];
                for (_, content) in &bundle.1 {
                    self.bring(content).await;
                }
            }
            3 => {
                let stray = vec![self.dice.below(250) as u8; 1 + self.dice.below(2_000)];
                self.bring(&stray).await;
            }
            4 | 5 => {
                let mut here = Vec::new();
                for bundle in &all {
                    if self.is_whole(bundle).await {
                        here.push(*bundle);
                    }
                }
                // Now and then somebody forgets to bring what is listed.
                let listed = if self.dice.below(4) == 0 { self.dice.some(&all) } else { self.dice.some(&here) };
                let whole = listed.iter().all(|bundle| here.iter().any(|known| std::ptr::eq(*known, *bundle)));
                let published = self.shop.publish(&listed).await;
                assert_eq!(published.is_ok(), whole, "exactly what is here can be published");
                if whole {
                    self.listed = listed;
                }
            }
            6 => {
                // Roll-outs begin with what is listed; rows name it for long after.
                let mut needed = self.dice.some(&self.needed);
                needed.extend(self.dice.some(&self.listed));
                self.shop.name(&needed);
                self.needed = needed;
            }
            7 => self.shop = self.shop.restarted().await,
            _ => {
                let ms = self.dice.below(TIME as usize) as u64;
                self.shop.after(ms).await;
            }
        }
        self
    }

    async fn holds(&self) {
        for digest in files(self.listed.iter().chain(&self.needed).copied()) {
            let reader = self.shop.content.read(digest, 0..u64::MAX).await.expect("readable");
            let mut bytes = Vec::new();
            reader.expect("it is needed").read_to_end(&mut bytes).await.expect("its bytes");
            assert_eq!(Digest::of_content(&bytes), digest);
        }
        let used = self.shop.content.fill().used_bytes;
        assert!(used <= QUOTA, "{used}");
        assert_eq!(used, bytes_in(&self.shop.dir.path().join("content")));
    }
}

#[tokio::test]
async fn what_is_needed_can_be_had_the_quota_holds_and_nothing_else_stays() {
    let line = line();
    let (mut refused, mut withdrawn, mut collected) = (0, 0, 0);
    for seed in 1..=20 {
        let (shop, dice) = (Shop::new(QUOTA).await, Dice(seed));
        let mut run = Run { shop, dice, line: &line, listed: Vec::new(), needed: Vec::new(), refused: 0 };
        for _ in 0..60 {
            run = run.act().await;
            run.holds().await;
            collected += usize::from(run.shop.collector.newest().is_some_and(|pass| pass.collected.files > 0));
            let listed = files(run.listed.iter().copied());
            withdrawn += usize::from(!files(run.needed.iter().copied()).is_subset(&listed));
        }
        run.shop.after(1).await;
        run.shop.after(TIME).await;
        let left = run.shop.content.list().await.expect("listed").into_iter().map(|stored| stored.digest);
        let kept = files(run.listed.iter().chain(&run.needed).copied());
        assert_eq!(left.collect::<BTreeSet<_>>(), kept, "seed {seed}");
        refused += run.refused;
    }
    // It was not proven of nothing.
    assert!(refused > 10 && withdrawn > 20 && collected > 20, "{refused} {withdrawn} {collected}");
}
