//! What becomes of tokens and robots in rows that were restored, before anybody serves from them.
//!
//! Invariant: nothing comes back that a list of revocations takes back, and nothing else changes, unless all tokens are to end.
//! Called by a restore with the rows of [`TABLES`].

use crate::tokens;
use midshift_core::identity::{Act, Actor, Revocation, RobotIdentity, Secret, TokenName, TokenRecord};
use midshift_core::item::{Expect, Item};
use midshift_core::rows::{BadRow, Record, Revision, Row, Table, Writer};
use midshift_core::time::Utc;
use std::collections::BTreeMap;

/// Rows that say who is known.
pub const TABLES: [Table; 3] = [Table::Token, Table::TokenName, Table::RobotIdentity];
/// Who does it, as an actor.
const BY: &str = "midshift";

/// What is to become of tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tokens {
    /// Those of the backup are as good as they were.
    Stay,
    /// All of them end, and a new one is made that may do everything.
    Reissue,
}

/// The rows that take access back after a restore, and how many tokens and keys end by them.
pub struct RestoredAccess {
    /// The rows.
    pub item: Item,
    /// Tokens that end.
    pub tokens: usize,
    /// Keys of robots that are taken out.
    pub keys: usize,
    /// The new token; none: none was asked for.
    pub secret: Option<String>,
    /// Whether a token stands that may administer the site.
    pub is_administered: bool,
}

struct View {
    tokens: BTreeMap<String, (TokenRecord, Option<Revision>)>,
    names: BTreeMap<String, (TokenName, Revision)>,
    robots: BTreeMap<String, (RobotIdentity, Option<Revision>)>,
}

impl View {
    fn read(rows: &[Row]) -> Result<Self, BadRow> {
        let (mut tokens, mut names, mut robots) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        for row in rows {
            let id = row.key.id.to_string();
            match row.key.table {
                Table::Token => drop(tokens.insert(id, (row.decode()?, Some(row.revision)))),
                Table::TokenName => drop(names.insert(id, (row.decode()?, row.revision))),
                Table::RobotIdentity => drop(robots.insert(id, (row.decode()?, Some(row.revision)))),
                _ => {}
            }
        }
        Ok(Self { tokens, names, robots })
    }
}

/// Whether these rows have a token or a robot that would be let in again.
///
/// # Errors
/// A row that cannot be read.
pub fn lets_somebody_in(rows: &[Row], now: Utc) -> Result<bool, BadRow> {
    let view = View::read(rows)?;
    let is_open = |robot: &RobotIdentity| robot.key.is_some() || robot.enrolment.is_some();
    Ok(view.tokens.values().any(|(token, _)| token.stands(now))
        || view.robots.values().any(|(robot, _)| is_open(robot)))
}

/// Merges a list into rows, and ends all tokens if asked to. Secrets that wait for their machine end too: one that was used since would enrol another.
///
/// # Errors
/// A row that cannot be read.
pub fn put_right(rows: &[Row], list: &[Revocation], ending: Tokens, now: Utc) -> Result<RestoredAccess, BadRow> {
    let mut view = View::read(rows)?;
    let before = (view.tokens.clone(), view.robots.clone());
    let (mut tokens, mut keys) = (0, 0);
    for line in list {
        match line {
            Revocation::Token { token_id, revoked } => {
                let known = view.tokens.get_mut(token_id.as_str());
                tokens += usize::from(known.is_some_and(|(token, _)| token.take_back(revoked)));
            }
            Revocation::Key { robot_id, deny, revoked } => {
                let fresh = || (RobotIdentity::new(robot_id.clone()), None);
                let (robot, _) = view.robots.entry(robot_id.to_string()).or_insert_with(fresh);
                keys += usize::from(robot.take_out(deny, revoked.as_ref()));
            }
        }
    }
    let mut item = Item::new(Writer::Identity, BY);
    let mut secret = None;
    if ending == Tokens::Reissue {
        let act = Act::new(BY, now.0);
        tokens += view.tokens.values_mut().map(|(token, _)| usize::from(token.take_back(&act))).sum::<usize>();
        let drawn = tokens::draw();
        let stands = |name: &str| view.tokens.values().any(|(token, _)| token.name == name && token.stands(now));
        let made = tokens::everything_of(tokens::spare_name(stands), &drawn, &Actor::from(BY), now);
        view.tokens.insert(made.id(), (made, None));
        secret = Some(drawn.reveal(Secret::TOKEN));
    }
    for (robot, _) in view.robots.values_mut() {
        robot.take_offer_back();
    }
    for (id, (token, at)) in &view.tokens {
        if before.0.get(id).is_none_or(|(known, _)| known != token) {
            item.put_row(token, at.map_or(Expect::Absent, Expect::At), "token.restored");
        }
    }
    for (id, (robot, at)) in &view.robots {
        if before.1.get(id).is_none_or(|(known, _)| known != robot) {
            item.put_row(robot, at.map_or(Expect::Absent, Expect::At), "robot.restored");
        }
    }
    put_names_right(&view, now, &mut item);
    let is_administered = view.tokens.values().any(|(token, _)| tokens::administers(token, now));
    Ok(RestoredAccess { item, tokens, keys, secret, is_administered })
}

/// A name goes with its token, and the new token takes its own.
fn put_names_right(view: &View, now: Utc, item: &mut Item) {
    let made = view.tokens.values().filter(|(_, at)| at.is_none());
    for (token, _) in made.clone() {
        let name = TokenName { name: token.name.clone(), token_id: token.token_id.clone() };
        let known = view.names.get(&token.name).map(|(_, at)| *at);
        item.put_row(&name, known.map_or(Expect::Absent, Expect::At), "token_name.taken");
    }
    for (name, at) in view.names.values() {
        let is_free = view.tokens.get(name.token_id.as_str()).is_some_and(|(token, _)| token.is_revoked(now));
        if is_free && !made.clone().any(|(token, _)| token.name == name.name) {
            item.delete(name.key(), *at, "token_name.free");
        }
    }
}
