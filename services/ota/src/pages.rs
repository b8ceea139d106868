//! Pages of bundles, by name and version. A page token names the last bundle of the page before, so that a release in between moves nothing.

use crate::collect::Pass;
use crate::content::Fill;
use crate::repository::Release;
use midshift_core::reason::Violations;
use midshift_core::task::raw::parse_version;
use midshift_core::time::Utc;
use midshift_proto::ota::v1;
use midshift_proto::pages;

/// Where a bundle stands: by name, then by version as numbers, then as text.
type Place<'a> = (&'a str, Option<(u64, u64, u64)>, &'a str);

fn place<'a>(name: &'a str, version: &'a str) -> Place<'a> {
    (name, parse_version(version), version)
}

/// One page out of all, which are sorted.
pub fn page(
    releases: &[Release],
    room: v1::SoftwareRoom,
    request: &v1::ListBundlesRequest,
) -> Result<v1::ListBundlesResponse, Violations> {
    let mut bad = Violations::default();
    let size = pages::size(request.page_size, &mut bad);
    let after = request.page_token.split_once('/').map(|(name, version)| place(name, version));
    if !request.page_token.is_empty() && after.is_none_or(|(_, version, _)| version.is_none()) {
        bad.add("page_token", "is no page token of this list");
    }
    if !bad.0.is_empty() {
        return Err(bad);
    }
    let of = |r: &Release| after.is_none_or(|after| place(&r.manifest.name, &r.manifest.version) > after);
    let mut rest = releases.iter().filter(|r| of(r));
    let page: Vec<&Release> = rest.by_ref().take(size).collect();
    let last = page.last().filter(|_| rest.next().is_some());
    let next_page_token = last.map(|r| format!("{}/{}", r.manifest.name, r.manifest.version)).unwrap_or_default();
    let bundles = page.into_iter().map(encode).collect();
    Ok(v1::ListBundlesResponse { bundles, next_page_token, room: Some(room), ..Default::default() })
}

/// How full the server is.
pub fn room(fill: Fill, encoded_bytes: u64, newest: Option<Pass>) -> v1::SoftwareRoom {
    v1::SoftwareRoom {
        used_bytes: fill.used_bytes,
        quota_bytes: fill.quota_bytes,
        encoded_bytes,
        unnamed_bytes: newest.map_or(0, |pass| pass.collected.unnamed_bytes),
        look_time: newest.map(|pass| timestamp(pass.at)),
    }
}

fn timestamp(at: Utc) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: at.0.div_euclid(1_000), nanos: (at.0.rem_euclid(1_000) * 1_000_000) as i32 }
}

fn encode(release: &Release) -> v1::Bundle {
    let manifest = &release.manifest;
    let components = manifest.components.iter().map(|c| v1::Component {
        name: c.name.clone(),
        version: c.version.clone(),
        kind: c.kind.as_str().to_owned(),
        hardware: c.hardware.iter().cloned().collect(),
        digest: c.digest.to_string(),
        length: c.length,
    });
    v1::Bundle {
        digest: release.digest.to_string(),
        name: manifest.name.clone(),
        version: manifest.version.clone(),
        description: manifest.description.clone(),
        components: components.collect(),
        length: manifest.length(),
        publish_time: Some(timestamp(release.seen)),
    }
}
