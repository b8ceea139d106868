//! A site as a user gives it: the built-in demo, or the text of a file, read by the ending of its name.

use super::{DEMO, Site, Source, grid, lif, lint, text};
use crate::reason::Refusal;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A site with the text it came from.
#[derive(Debug)]
pub struct Loaded {
    /// The site.
    pub site: Arc<Site>,
    /// Its text, kept in the store.
    pub text: String,
    /// What the lint or the import has to say.
    pub warnings: Vec<String>,
}

/// Why a text is no site that can be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// It has none of the forms of a site.
    #[error("{path} is not a site that can be used:\n{}", violations.join("\n"), path = path.display())]
    Form {
        /// The file that it was read from.
        path: PathBuf,
        /// A line for each rule that a field of it breaks.
        violations: Vec<String>,
    },
    /// It breaks a rule of maps.
    #[error("site {site_id} breaks rules of maps (see `midshift map lint`):\n{}", findings.join("\n"))]
    Map {
        /// The site.
        site_id: String,
        /// A line for each finding.
        findings: Vec<String>,
    },
}

fn unusable(path: &Path, refusal: &Refusal) -> Error {
    let violations = refusal.violations.iter().map(|v| format!("  {}: {}", v.field, v.description)).collect();
    Error::Form { path: path.to_owned(), violations }
}

/// The built-in demo, for so many robots if that is known.
///
/// # Errors
/// So many robots break a rule of its map.
pub fn demo(robots: Option<u64>) -> Result<Loaded, Error> {
    parse(Path::new("demo.site.toml"), DEMO.to_owned(), robots)
}

/// The site in the text of a file: `.map` is a grid, `.json` is LIF, anything else a site file.
///
/// # Errors
/// It is none, or breaks a rule of maps.
pub fn parse(path: &Path, body: String, robots: Option<u64>) -> Result<Loaded, Error> {
    let name = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or("site");
    let parsed = match path.extension().and_then(|ending| ending.to_str()) {
        Some("map") => grid::parse_map(name, &body).map(|site| (site, Vec::new())),
        Some("json") => lif::parse(name, &body).map(|import| (import.site, import.warnings)),
        _ => text::parse(&body).map(|site| (site, Vec::new())),
    };
    let (site, mut warnings) = parsed.map_err(|refusal| unusable(path, &refusal))?;
    let findings = lint::lint(&site, robots);
    let words = |finding: &lint::Finding| format!("{}: {}", finding.rule.as_str(), finding.message);
    if site.source() == Source::Authored && lint::refuses(&findings) {
        let findings = findings.iter().map(|finding| format!("  {}", words(finding))).collect();
        return Err(Error::Map { site_id: site.site_id().to_string(), findings });
    }
    warnings.extend(findings.iter().map(words));
    Ok(Loaded { site: Arc::new(site), text: body, warnings })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_that_is_no_site_is_told_with_its_file_and_each_field() {
        assert_eq!(demo(None).expect("the demo").text, DEMO);
        let refused =
            parse(Path::new("/etc/my.site.toml"), "no site".to_owned(), None).expect_err("no site").to_string();
        assert!(refused.starts_with("/etc/my.site.toml is not a site that can be used:\n  "), "{refused}");
    }
}
