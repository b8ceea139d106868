//! Encoded downloads of a file: taken when they lead there, left for good when they do not.

use crate::release::Releases;
use crate::sets::{noise, patch, wanted};
use midshift_agent::sets::memory::MemorySets;
use midshift_agent::sets::{CHUNK_BYTES, FileRef, Sets};
use midshift_agent::update::io::{DownloadPlan, UpdateWorker, Worker};
use midshift_agent::update::{Done, Failure, Job};
use midshift_bundle::digest::Digest;
use std::sync::Arc;
use tokio_util::sync::CancellationToken;

/// A robot that has the old program, and a server that has the new one and a patch.
struct Bench {
    releases: Releases,
    sets: MemorySets,
    old: Vec<u8>,
    new: Vec<u8>,
    patch: Vec<u8>,
}

impl Bench {
    fn new() -> Self {
        let old = noise(1, 3 * CHUNK_BYTES as usize);
        let mut new = old.clone();
        new.splice(70_000..70_000, noise(2, 900));
        let patch = patch(&old, &new);
        let (releases, mut sets) = (Releases::new(), MemorySets::new());
        crate::sets::put_content(&mut sets, &old);
        for bytes in [&old, &new, &patch] {
            releases.hold(bytes);
        }
        Self { releases, sets, old, new, patch }
    }
    /// What the server says of ways to the new program.
    fn says(&self, ways: Vec<DownloadPlan>) {
        self.releases.ways(&wanted(&self.new), ways);
    }
    fn patched(&self) -> DownloadPlan {
        DownloadPlan::Shorter { base: Some(Digest::of_content(&self.old)), encoded: wanted(&self.patch) }
    }
    async fn fetch(&self) -> Done {
        let mut worker = UpdateWorker::new(Box::new(self.sets.clone()), Arc::new(self.releases.clone()));
        let job = Job::Fetch { wanted: wanted(&self.new), bases: vec![Digest::of_content(&self.old)], rate_bytes_s: 0 };
        worker.work(job, CancellationToken::new()).await
    }
    fn has_new(&self) -> bool {
        let FileRef { digest, length } = wanted(&self.new);
        self.sets.clone().read(&digest, length).is_ok_and(|bytes| bytes == self.new)
    }
}

#[tokio::test(start_paused = true)]
async fn a_patch_from_what_is_installed_brings_a_file_with_few_bytes_and_leaves_nothing_behind() {
    let bench = Bench::new();
    bench.says(vec![bench.patched()]);
    assert!(matches!(bench.fetch().await, Done::Ok));
    assert!(bench.has_new());
    assert_eq!(bench.releases.served(), bench.patch.len() as u64);
    assert!(bench.patch.len() < bench.new.len() / 100);
    assert_eq!(bench.releases.asked(), vec![vec![Digest::of_content(&bench.old)]]);
    assert!(bench.sets.clone().read(&Digest::of_content(&bench.patch), 1 << 20).is_err(), "the patch went");
}

#[tokio::test(start_paused = true)]
async fn a_download_keeps_to_its_rate_whatever_the_line_carries() {
    let bench = Bench::new();
    let length = bench.new.len() as u64;
    for (rate_bytes_s, at_least_ms) in [(0, 0), (CHUNK_BYTES as u32 / 2, 2_000 * length / CHUNK_BYTES)] {
        let mut worker = UpdateWorker::new(Box::new(MemorySets::new()), Arc::new(bench.releases.clone()));
        let begun = tokio::time::Instant::now();
        let job = Job::Fetch { wanted: wanted(&bench.new), bases: Vec::new(), rate_bytes_s };
        assert!(matches!(worker.work(job, CancellationToken::new()).await, Done::Ok));
        let virtual_ms = begun.elapsed().as_millis() as u64;
        assert!((at_least_ms..=at_least_ms + 1).contains(&virtual_ms), "{virtual_ms} of {at_least_ms} ms");
    }
}

#[tokio::test(start_paused = true)]
async fn a_way_that_does_not_lead_there_is_left_for_good_and_the_file_comes_as_it_is() {
    let bench = Bench::new();
    let mut tampered = bench.patch.clone();
    tampered[500] ^= 1;
    let other = patch(&bench.old, &[noise(9, 900), bench.old.clone()].concat());
    let bomb = crate::sets::bomb();
    for wrong in [&tampered, &other, &bomb] {
        let bench = Bench::new();
        let encoded = bench.releases.hold(wrong);
        bench.says(vec![DownloadPlan::Shorter { base: Some(Digest::of_content(&bench.old)), encoded }]);
        assert!(matches!(bench.fetch().await, Done::Ok));
        assert!(bench.has_new());
        assert_eq!(bench.releases.served(), (wrong.len() + bench.new.len()) as u64);
        assert_eq!(bench.releases.asked().len(), 1);
    }
    // What comes is not even what was said.
    let bench = Bench::new();
    bench.says(vec![bench.patched()]);
    bench.releases.corrupt(true);
    assert!(matches!(bench.fetch().await, Done::Failed(Failure::Refused(_))), "the file itself is corrupt too");
    assert!(bench.sets.clone().is_fetched_as_it_is(&wanted(&bench.new)).expect("tells"));
    bench.releases.corrupt(false);
    assert!(matches!(bench.fetch().await, Done::Ok));
    assert_eq!(bench.releases.asked().len(), 1, "it is not asked for again");
}

#[tokio::test(start_paused = true)]
async fn an_answer_that_cannot_be_meant_is_not_followed() {
    let bench = Bench::new();
    let base = Some(Digest::of_content(&bench.old));
    let (new, patch) = (wanted(&bench.new), wanted(&bench.patch));
    let cases = [
        DownloadPlan::Shorter { base: Some(Digest::of_content(b"of nobody")), encoded: patch },
        DownloadPlan::Shorter { base, encoded: FileRef { length: new.length, ..patch } },
        DownloadPlan::Shorter { base, encoded: FileRef { length: 0, ..patch } },
        DownloadPlan::Shorter { base, encoded: FileRef { length: 100, ..new } },
    ];
    for way in cases {
        let bench = Bench::new();
        bench.says(vec![way]);
        assert!(matches!(bench.fetch().await, Done::Ok), "{way:?}");
        assert!(bench.has_new());
        assert_eq!(bench.releases.served(), new.length, "{way:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_way_that_went_or_a_base_that_rotted_does_not_keep_a_file_from_coming() {
    let bench = Bench::new();
    bench.says(vec![bench.patched()]);
    bench.releases.drop_bytes(&Digest::of_content(&bench.patch));
    assert!(matches!(bench.fetch().await, Done::Ok) && bench.has_new());
    assert!(!bench.sets.clone().is_fetched_as_it_is(&wanted(&bench.new)).expect("tells"));
    let bench = Bench::new();
    bench.says(vec![bench.patched()]);
    bench.sets.rot(&Digest::of_content(&bench.old));
    assert!(matches!(bench.fetch().await, Done::Ok) && bench.has_new());
}

#[tokio::test(start_paused = true)]
async fn without_the_server_the_way_is_kept_in_mind_and_a_begun_file_goes_on_as_it_is() {
    let bench = Bench::new();
    bench.says(vec![bench.patched()]);
    bench.releases.cut(true);
    assert!(matches!(bench.fetch().await, Done::Failed(Failure::Later(_))));
    bench.releases.cut(false);
    assert!(matches!(bench.fetch().await, Done::Ok) && bench.has_new());
    assert_eq!(bench.releases.served(), bench.patch.len() as u64);
    let bench = Bench::new();
    bench.says(vec![bench.patched()]);
    let new = wanted(&bench.new);
    bench.sets.clone().write(&new, 0, &bench.new[..CHUNK_BYTES as usize]).expect("writes");
    assert!(matches!(bench.fetch().await, Done::Ok) && bench.has_new());
    assert_eq!(bench.releases.served(), new.length - CHUNK_BYTES);
}
