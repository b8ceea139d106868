//! Rules of an area for roll-outs of software, in flags and in words. Both have the same form: what is shown can be put.

use midshift_proto::fleet::v1::{MaintenanceWindow, SoftwareRules};

/// Days as people write them, Monday first.
const DAYS: [&str; 7] = ["mon", "tue", "wed", "thu", "fri", "sat", "sun"];

/// What is to change; what is not named stays.
#[derive(clap::Args)]
pub struct Rules {
    /// So many of a hundred robots may be out of work at once; one always may.
    #[arg(long, value_name = "PERCENT")]
    off_work: Option<u32>,
    /// So many robots with this capability stay in work, e.g. pick=3; pick=0 takes the rule away. Other capabilities stay as they are.
    #[arg(long, value_name = "CAPABILITY=ROBOTS", value_parser = parse_kept_in_work)]
    keep_in_work: Vec<(String, u32)>,
    /// Robots are taken out of work only then, e.g. "mon-fri 22:00-05:00 Europe/Berlin" or "daily 01:00-04:00 UTC". Takes the place of
    /// all windows before; "always" leaves none.
    #[arg(long, value_name = "WINDOW", value_parser = parse_window)]
    window: Vec<Window>,
    /// No robot is taken out of work for a roll-out.
    #[arg(long, value_name = "true|false", action = clap::ArgAction::Set)]
    frozen: Option<bool>,
    /// A suspicion from rates of task failures ends roll-outs whose bundle a robot of the area has run. Without it that is only shown.
    #[arg(long, value_name = "true|false", action = clap::ArgAction::Set)]
    acts_on_rates: Option<bool>,
}

/// One window, or that there is none.
#[derive(Clone, Debug, PartialEq)]
enum Window {
    Always,
    At(MaintenanceWindow),
}

impl Rules {
    /// The rules after the change.
    pub fn over(self, old: SoftwareRules) -> SoftwareRules {
        let mut rules = old;
        if let Some(percent) = self.off_work {
            rules.off_work_permille = Some(percent.saturating_mul(10));
        }
        for (capability, robots) in self.keep_in_work {
            match robots {
                0 => rules.keep_in_work.remove(&capability),
                robots => rules.keep_in_work.insert(capability, robots),
            };
        }
        if !self.window.is_empty() {
            let at = |window| match window {
                Window::Always => None,
                Window::At(window) => Some(window),
            };
            rules.windows = self.window.into_iter().filter_map(at).collect();
        }
        rules.frozen = self.frozen.unwrap_or(rules.frozen);
        rules.acts_on_rates = self.acts_on_rates.unwrap_or(rules.acts_on_rates);
        rules
    }
}

fn parse_kept_in_work(text: &str) -> Result<(String, u32), String> {
    let bad = || "must be CAPABILITY=ROBOTS, e.g. pick=3".to_owned();
    let (capability, robots) = text.split_once('=').filter(|(c, _)| !c.is_empty()).ok_or_else(bad)?;
    Ok((capability.to_owned(), robots.parse().map_err(|_| bad())?))
}

fn parse_window(text: &str) -> Result<Window, String> {
    let bad = || "must be DAYS FROM-TO ZONE, e.g. \"mon-fri 22:00-05:00 Europe/Berlin\", or always".to_owned();
    if text == "always" {
        return Ok(Window::Always);
    }
    let mut words = text.split_whitespace();
    let (Some(on), Some(hours), Some(zone), None) = (words.next(), words.next(), words.next(), words.next()) else {
        return Err(bad());
    };
    let (from, to) = hours.split_once('-').ok_or_else(bad)?;
    let days = days(on).ok_or_else(bad)?;
    let (from_minute, to_minute) = minute(from).zip(minute(to)).ok_or_else(bad)?;
    Ok(Window::At(MaintenanceWindow { days, from_minute, to_minute, zone: zone.to_owned() }))
}

/// `daily`, `sat`, `mon-fri`, `sat-mon`, `mon,wed-fri`.
fn days(text: &str) -> Option<Vec<u32>> {
    if text == "daily" {
        return Some(Vec::new());
    }
    let day = |name: &str| (1..).zip(DAYS).find(|(_, d)| *d == name).map(|(number, _)| number);
    let mut days = Vec::new();
    for part in text.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (mut at, last) = (day(first)?, day(last)?);
        days.push(at);
        while at != last {
            at = at % 7 + 1;
            days.push(at);
        }
    }
    days.sort_unstable();
    days.dedup();
    Some(days)
}

/// Minute of the day of `HH:MM`.
fn minute(text: &str) -> Option<u32> {
    let (hours, minutes) = text.split_once(':')?;
    let (hours, minutes): (u32, u32) = (hours.parse().ok()?, minutes.parse().ok()?);
    (hours < 24 && minutes < 60).then_some(hours * 60 + minutes)
}

fn format_window(window: &MaintenanceWindow) -> String {
    let name = |day: &u32| DAYS.get((*day as usize).wrapping_sub(1)).copied().unwrap_or("?");
    let days = if window.days.is_empty() {
        "daily".to_owned()
    } else {
        window.days.iter().map(name).collect::<Vec<_>>().join(",")
    };
    let clock = |minute: u32| format!("{:02}:{:02}", minute / 60, minute % 60);
    format!("{days} {}-{} {}", clock(window.from_minute), clock(window.to_minute), window.zone)
}

/// The rules on a line of their own.
pub fn shown(rules: &SoftwareRules) -> String {
    let percent = f64::from(rules.off_work_permille.unwrap_or(100)) / 10.0;
    let mut text = format!("\n  software: at most {percent} % out of work");
    if !rules.keep_in_work.is_empty() {
        let kept: Vec<String> = rules.keep_in_work.iter().map(|(capability, n)| format!("{capability}={n}")).collect();
        text += &format!("  keep in work {}", kept.join(" "));
    }
    let windows: Vec<String> = rules.windows.iter().map(format_window).collect();
    text += &if windows.is_empty() { "  at any time".to_owned() } else { format!("  only {}", windows.join("; ")) };
    text += if rules.acts_on_rates { "  rates of failures act" } else { "" };
    text + if rules.frozen { "  FROZEN" } else { "" }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(text: &str) -> MaintenanceWindow {
        match parse_window(text) {
            Ok(Window::At(window)) => window,
            other => panic!("{text}: {other:?}"),
        }
    }

    #[test]
    fn windows_read_as_they_are_shown() {
        let friday = at("sat-mon,wed 22:00-05:30 Europe/Berlin");
        assert_eq!((friday.days.as_slice(), friday.from_minute, friday.to_minute), (&[1, 3, 6, 7][..], 1_320, 330));
        for text in ["daily 01:00-04:00 UTC", "mon,tue,wed,thu,fri 22:00-05:00 Europe/Berlin", "sun 00:00-23:59 UTC"] {
            assert_eq!(format_window(&at(text)), text);
        }
        assert_eq!(parse_window("always"), Ok(Window::Always));
        for bad in [
            "",
            "never",
            "mon 24:00-05:00 UTC",
            "mon 1-2 UTC",
            "mun 01:00-02:00 UTC",
            "mon 01:00-02:00",
            "mon 01:00-02:00 UTC x",
        ] {
            assert!(parse_window(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn what_is_not_named_stays() {
        let nothing = || Rules {
            off_work: None,
            keep_in_work: Vec::new(),
            window: Vec::new(),
            frozen: None,
            acts_on_rates: None,
        };
        let old = SoftwareRules {
            off_work_permille: Some(150),
            keep_in_work: [("pick".to_owned(), 3), ("lift".to_owned(), 1)].into(),
            windows: vec![at("daily 01:00-04:00 UTC")],
            frozen: true,
            acts_on_rates: true,
        };
        assert_eq!(nothing().over(old.clone()), old);
        let change = Rules {
            off_work: Some(20),
            keep_in_work: vec![("pick".to_owned(), 0), ("tow".to_owned(), 2)],
            window: vec![Window::Always],
            frozen: Some(false),
            acts_on_rates: None,
        };
        let new = change.over(old);
        let expected = "\n  software: at most 20 % out of work  keep in work lift=1 tow=2  at any time";
        assert_eq!(shown(&new), format!("{expected}  rates of failures act"));
        assert_eq!(shown(&Rules { acts_on_rates: Some(false), ..nothing() }.over(new)), expected);
    }

    #[test]
    fn kept_capabilities_are_names_and_numbers() {
        assert_eq!(parse_kept_in_work("pick=3"), Ok(("pick".to_owned(), 3)));
        assert!(
            parse_kept_in_work("pick").is_err()
                && parse_kept_in_work("=3").is_err()
                && parse_kept_in_work("pick=some").is_err()
        );
    }
}
