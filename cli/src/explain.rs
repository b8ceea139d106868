//! Reasons in words: of an explanation, and `midshift explain-error`: what a reason means and what to try.

use super::client::Exit;
use super::duration::span;
use super::out::{Format, Out, plain};
use midshift_core::fleet::WAITS_FOR;
use midshift_core::reason::Code;
use midshift_proto::common::v1::Reason;
use midshift_proto::convert::{duration, time_of};
use midshift_proto::fleet::v1::{PairCost, PlanChoice, RobotEnergy, TaskExplanation};

/// The lines of an explanation that say what is done or waited for; `nothing`: in case there is no reason.
pub fn verdict(reason: Option<&Reason>, nothing: &str) -> String {
    let Some(reason) = reason else { return format!("\n  {nothing}\n") };
    let told = format!("\n  {}: {}\n", reason.code, plain(&reason.message));
    match reason.metadata.get(WAITS_FOR).filter(|what| !what.is_empty()) {
        Some(what) => told + &format!("  waits for {}\n", plain(what)),
        None => told,
    }
}

/// How soon a task will probably get a robot.
pub fn expected_start(e: &TaskExplanation) -> String {
    let left = |at: &Option<prost_types::Timestamp>| {
        let (at, now) = at.as_ref().zip(e.explain_time.as_ref())?;
        let ms = time_of(at).ms_since(time_of(now));
        Some(span(&duration(ms)))
    };
    match left(&e.expected_start_p10_time).zip(left(&e.expected_start_p90_time)) {
        Some((from, until)) => format!("  lately eight of ten such tasks got a robot within {from} to {until}\n"),
        None => String::new(),
    }
}

/// Why a plan chose a robot for a task, and what the next ones would have cost.
pub fn choice(choice: &PlanChoice) -> String {
    let robot = plain(&choice.robot_id);
    let at = choice.plan_time.as_ref().map_or_else(String::new, |at| format!(" at {}", time_of(at).rfc3339()));
    let chosen = format!("{} {robot}{at}", if choice.given { "given to" } else { "meant for" });
    let mut text = format!("  {chosen}: weighs {}\n", choice.cost.as_ref().map_or_else(String::new, cost));
    for next in &choice.next {
        let took = match next.task_id.as_str() {
            "" => String::new(),
            task => format!(", which went with {}", plain(task)),
        };
        let cost = next.cost.as_ref().map_or_else(String::new, cost);
        text += &format!("  next {}: would weigh {cost}{took}\n", plain(&next.robot_id));
    }
    text
}

/// A cost in seconds on the way as they were weighed (those of a normal task count twice), with the terms that are not 0.
fn cost(cost: &PairCost) -> String {
    let seconds = |ms: i64| format!("{:.1} s", ms as f64 / 1_000.0);
    let terms = [
        ("until it is free", cost.ready_ms),
        ("way", cost.way_ms),
        ("failed it before", cost.failed_ms),
        ("charge", cost.charge_ms),
        ("energy", cost.energy_ms),
        ("late", cost.lateness_ms),
        ("waited", cost.age_ms),
        ("meant for it before", cost.kept_ms),
    ];
    let terms = terms.iter().filter(|(_, ms)| *ms != 0).map(|(name, ms)| format!("{name} {}", seconds(*ms)));
    let terms = terms.collect::<Vec<_>>().join(", ");
    let total = seconds(cost.total_ms);
    if terms.is_empty() { total } else { format!("{total} ({terms})") }
}

/// The line of a robot's explanation that says what its work takes from the battery.
pub fn energy(energy: &RobotEnergy) -> String {
    let thousandth = |value: u32| f64::from(value) / 1_000.0;
    let rates = format!(
        "{:.1} Wh a km, {:.1} with a load, {:.1} W standing, {:.2} Wh an action",
        thousandth(energy.empty_mwh_per_km),
        thousandth(energy.loaded_mwh_per_km),
        thousandth(energy.idle_mw),
        thousandth(energy.action_mwh),
    );
    let attempts = energy.attempts;
    match energy.error_permille {
        Some(error) => {
            let percent = f64::from(error) / 10.0;
            format!("  energy {rates}, fitted to {attempts} attempts, which lie {percent:.1} % beside it\n")
        }
        None => format!("  energy {rates}: figures of the model, its {attempts} attempts are too few\n"),
    }
}

/// One code, or all.
pub fn error(code: Option<&str>, out: &Out) -> Result<(), Exit> {
    let codes: Vec<Code> = match code {
        None => Code::ALL.to_vec(),
        Some(text) => {
            let name = text.to_uppercase().replace('-', "_");
            vec![
                name.parse()
                    .map_err(|()| Exit::new(4, format!("there is no reason {text}\n  try: midshift explain-error")))?,
            ]
        }
    };
    for code in codes {
        match out.format {
            Format::Table => out.line(&format!("{code}\n  {}", code.help())),
            Format::Name => out.line(code.as_str()),
            Format::Json | Format::Jsonl => {
                out.line(&serde_json::json!({"code": code.as_str(), "help": code.help()}).to_string())
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_proto::fleet::v1::NextRobot;

    #[test]
    fn a_choice_names_its_terms_and_what_the_next_robots_took() {
        let way = |way_ms, age_ms| PairCost { total_ms: way_ms + age_ms, way_ms, age_ms, ..PairCost::default() };
        let next = NextRobot { robot_id: "r2".into(), cost: Some(way(9_000, -1_500)), task_id: "T2".into() };
        let said = choice(&PlanChoice {
            robot_id: "r1".into(),
            given: true,
            cost: Some(way(12_000, -1_500)),
            next: vec![next],
            ..PlanChoice::default()
        });
        let told = "  given to r1: weighs 10.5 s (way 12.0 s, waited -1.5 s)\n";
        assert_eq!(
            said,
            told.to_owned() + "  next r2: would weigh 7.5 s (way 9.0 s, waited -1.5 s), which went with T2\n"
        );
    }

    #[test]
    fn the_energy_of_a_robot_is_told_with_its_error_or_as_the_models() {
        let model = RobotEnergy {
            empty_mwh_per_km: 120_000,
            loaded_mwh_per_km: 156_000,
            idle_mw: 80_000,
            action_mwh: 500,
            error_permille: None,
            attempts: 3,
        };
        let rates = "  energy 120.0 Wh a km, 156.0 with a load, 80.0 W standing, 0.50 Wh an action";
        assert_eq!(energy(&model), rates.to_owned() + ": figures of the model, its 3 attempts are too few\n");
        let fitted = RobotEnergy { error_permille: Some(24), attempts: 57, ..model };
        assert_eq!(energy(&fitted), rates.to_owned() + ", fitted to 57 attempts, which lie 2.4 % beside it\n");
    }

    #[test]
    fn a_cost_names_the_energy_that_its_way_takes_more_or_less() {
        let of = |energy_ms| {
            cost(&PairCost { total_ms: 2_000 + energy_ms, way_ms: 2_000, energy_ms, ..PairCost::default() })
        };
        assert_eq!(of(700), "2.7 s (way 2.0 s, energy 0.7 s)");
        assert_eq!(of(-300), "1.7 s (way 2.0 s, energy -0.3 s)");
    }

    #[test]
    fn an_explanation_names_what_is_waited_for_where_something_is() {
        let mut reason =
            Reason { code: "PLACE_OCCUPIED".into(), message: "waits for a place".into(), ..Reason::default() };
        assert_eq!(verdict(Some(&reason), "-"), "\n  PLACE_OCCUPIED: waits for a place\n");
        reason.metadata.insert(WAITS_FOR.into(), "door: held by r1".into());
        assert!(verdict(Some(&reason), "-").ends_with("\n  waits for door: held by r1\n"));
        assert_eq!(verdict(None, "nothing holds it"), "\n  nothing holds it\n");
    }
}
