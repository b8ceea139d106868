//! Makes, lists and revokes tokens of people and programs.
//!
//! Invariant: of the tokens that stand no two are made of one name, also by two processes at once: who makes one writes the row of its name as it was read.

pub mod rotate;

use crate::register::{Register, View, decided};
use midshift_core::audit::Note;
use midshift_core::identity::{
    Act, Actor, Digest, Grant, HeldGrant, Permission, Role, Scope, Secret, TokenId, TokenName, TokenRecord,
};
use midshift_core::item::{Expect, Item};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rows::{Record, Revision, Writer};
use midshift_core::time::{LinkDuration, Utc};
use midshift_proto::identity::v1;
use sha2::Digest as _;
use std::sync::Arc;

/// Name of the first token.
const FIRST: &str = "admin";
/// Characters of a token's id.
const ID_CHARS: usize = 10;
const NAME_MAX: usize = 64;
/// Names that stand in the audit for midshift itself, beside those of its services, or for whoever shows nothing.
const RESERVED: [&str; 3] = ["anonymous", "nobody", "midshift"];
const DAY: LinkDuration = LinkDuration::from_secs(24 * 3_600);

/// A secret from the system's randomness, under an id of its own.
pub fn draw() -> Secret {
    const ALPHABET: &[u8; 32] = b"abcdefghijkmnpqrstuvwxyz23456789";
    let random: [u8; ID_CHARS] = rand::random();
    let id: String = random.iter().map(|byte| char::from(ALPHABET[usize::from(byte % 32)])).collect();
    let fits = TokenId::new(&id);
    // The alphabet is one of ids.
    Secret::new(fits.unwrap_or_else(|| unreachable!("letters and digits")), rand::random())
}

/// What is kept of a secret.
pub fn digest(secret: &Secret) -> Digest {
    Digest(sha2::Sha256::digest(secret.bytes()).into())
}

/// A token that is to be made.
#[derive(Clone, Debug)]
pub struct NewToken {
    /// Who it stands for.
    pub name: String,
    /// The person who has it; none: the name stands for itself.
    pub person: Option<Arc<str>>,
    /// Its rights.
    pub grants: Vec<Grant>,
    /// How long.
    pub valid: LinkDuration,
}

/// Checks the name of a token or of a person.
fn check_name(field: &str, name: &str, bad: &mut Violations) {
    let is_fit = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-_.@".contains(c);
    if name.is_empty() || name.len() > NAME_MAX || !name.chars().all(is_fit) {
        bad.add(field, "must be 1-64 of [a-z0-9-_.@]");
    } else if RESERVED.contains(&name) || Writer::ALL.iter().any(|service| service.as_str() == name) {
        bad.add(field, "stands for midshift itself in the audit, or for nobody: choose another");
    }
}

/// Checks how long a token is to be good.
fn check_valid(valid_seconds: u64, bad: &mut Violations) -> LinkDuration {
    let days = DAY.as_ms() / 1000..=limits::TOKEN_VALID_MAX.as_ms() / 1000;
    if days.contains(&valid_seconds) {
        return LinkDuration::from_secs(valid_seconds);
    }
    bad.add("valid_seconds", "must be 86400..31622400: 1 to 366 days");
    DAY
}

impl NewToken {
    /// Checks what was asked for.
    ///
    /// # Errors
    /// Each broken rule.
    pub fn check(r: &v1::CreateTokenRequest) -> Result<Self, Refusal> {
        let mut bad = Violations::default();
        check_name("name", &r.name, &mut bad);
        if !r.person.is_empty() {
            check_name("person", &r.person, &mut bad);
        }
        if r.grants.is_empty() || r.grants.len() > limits::GRANTS_MAX {
            bad.add("grants", format!("must be 1-{}: what it may do", limits::GRANTS_MAX));
        }
        let read = |(n, text): (usize, &String)| {
            let (field, grant) = (format!("grants[{n}]"), text.parse::<Grant>());
            let grant = bad.accept(&field, grant)?;
            if matches!(grant, Grant { role: Role::Admin | Role::Auditor, scope: Scope::Area(_) }) {
                let role = grant.role.as_str();
                bad.add(field, format!("{grant} permits no more than viewer does: {role} is of the whole site"));
            }
            Some(grant)
        };
        let grants: Vec<Grant> = r.grants.iter().enumerate().filter_map(read).collect();
        let valid = check_valid(r.valid_seconds, &mut bad);
        bad.finish()?;
        let person = (!r.person.is_empty()).then(|| r.person.as_str().into());
        Ok(Self { name: r.name.clone(), person, grants, valid })
    }

    fn record(&self, secret: &Secret, actor: &Actor, now: Utc) -> TokenRecord {
        TokenRecord {
            token_id: secret.id().clone(),
            name: self.name.clone(),
            person: self.person.clone(),
            digest: digest(secret),
            grants: self.grants.iter().cloned().map(Into::into).collect(),
            created_unix_ms: now.0,
            created_by: actor.to_string(),
            expires_unix_ms: now.0.saturating_add_unsigned(self.valid.as_ms()),
            revoked: None,
            rotation: None,
        }
    }
}

/// A token that may do everything, under a name that nobody has.
pub fn everything_of(name: String, secret: &Secret, by: &Actor, now: Utc) -> TokenRecord {
    TokenRecord { name, ..everything().record(secret, by, now) }
}

/// The first name of its kind that nobody has.
pub fn spare_name(is_taken: impl Fn(&str) -> bool) -> String {
    let more = (2_u64..).map(|n| format!("{FIRST}-{n}"));
    let mut names = std::iter::once(FIRST.to_owned()).chain(more);
    names.find(|name| !is_taken(name)).unwrap_or_else(|| FIRST.to_owned())
}

fn everything() -> NewToken {
    let site = |role| Grant { role, scope: Scope::Site };
    let roles = [
        Role::Admin,
        Role::Operator,
        Role::OtaAuthor,
        Role::OtaApprover,
        Role::OtaFullPush,
        Role::StopResetter,
        Role::Auditor,
    ];
    NewToken { name: FIRST.to_owned(), person: None, grants: roles.map(site).into(), valid: limits::TOKEN_VALID_MAX }
}

fn note(action: &'static str, token: &TokenRecord) -> Note {
    Note::new(action).about("token", &token.token_id).with("name", &token.name)
}

/// Tokens of this name that let somebody in.
fn standing<'v>(view: &'v View, name: &str, now: Utc) -> impl Iterator<Item = &'v (TokenRecord, Revision)> {
    view.tokens.values().filter(move |(token, _)| token.name == name && token.stands(now))
}

fn taken(name: &str, kind: Kind) -> Refusal {
    Refusal::new(kind, Reason::from(Code::TokenNameTaken).with("name", name))
}

/// The item of a new token, which takes its name on the condition that nobody else took it meanwhile.
fn made(view: &View, record: &TokenRecord, by: &Actor, note: Note) -> Item {
    let mut item = decided(record, None, by, "token.created", note);
    let name = TokenName { name: record.name.clone(), token_id: record.token_id.clone() };
    let known = view.names.get(&record.name).map(|(_, at)| *at);
    item.put_row(&name, known.map_or(Expect::Absent, Expect::At), "token_name.taken");
    item
}

fn created(view: &View, record: &TokenRecord, by: &Actor) -> Item {
    let grants: Vec<String> = record.grants.iter().map(ToString::to_string).collect();
    let note = note("token.create", record).with("grants", grants.join(" "));
    let note = record.person.iter().fold(note, |note, person| note.with("person", person));
    made(view, record, by, note)
}

/// The first token of a site; none if there ever was one.
pub async fn first(register: &Register, now: Utc) -> Result<Option<Secret>, Refusal> {
    let (secret, by) = (draw(), Actor::from("midshift"));
    let record = everything().record(&secret, &by, now);
    let made = register.decide(|view| match view.tokens.is_empty() {
        true => Ok((Some(created(view, &record, &by)), true)),
        false => Ok((None, false)),
    });
    Ok(made.await?.then_some(secret))
}

/// Another token that may do everything, under the first name of its kind that nobody has.
pub async fn spare(register: &Register, now: Utc) -> Result<Secret, Refusal> {
    let (secret, by) = (draw(), Actor::from("midshift"));
    register
        .decide(|view| {
            let name = spare_name(|name| standing(view, name, now).next().is_some());
            Ok((Some(created(view, &everything_of(name, &secret, &by, now), &by)), ()))
        })
        .await?;
    Ok(secret)
}

/// A new token.
///
/// # Errors
/// A token of its name stands, or there are too many; the store.
pub async fn create(
    register: &Register,
    wanted: &NewToken,
    by: &Actor,
    now: Utc,
) -> Result<(TokenRecord, Secret), Refusal> {
    let secret = draw();
    let record = wanted.record(&secret, by, now);
    register
        .decide(|view| {
            let live = view.tokens.values().filter(|(token, _)| token.revoked.is_none()).count();
            if live >= limits::TOKENS_MAX {
                let text = format!("the site has {live} tokens that were not revoked: revoke those that nobody uses");
                return Err(Refusal::new(Kind::Exhausted, Reason::new(Code::Overloaded, text)));
            }
            match standing(view, &wanted.name, now).next() {
                Some(_) => Err(taken(&wanted.name, Kind::AlreadyExists)),
                None => Ok((Some(created(view, &record, by)), ())),
            }
        })
        .await?;
    Ok((record, secret))
}

/// Takes one back.
///
/// # Errors
/// It is not there, or is the last that may administer the site; the store.
pub async fn revoke(register: &Register, token_id: &TokenId, by: &Actor, now: Utc) -> Result<TokenRecord, Refusal> {
    let not_found = || Refusal::new(Kind::NotFound, Reason::from(Code::TokenNotFound).with("token_id", token_id));
    let asked = Note::new("token.revoke").about("token", token_id);
    register
        .decide_for(by, asked, |view| {
            let (token, at) = view.tokens.get(token_id).ok_or_else(not_found)?;
            if token.is_revoked(now) {
                return Ok((None, token.clone()));
            }
            if administers(token, now)
                && !view.tokens.values().any(|(t, _)| t.token_id != *token_id && administers(t, now))
            {
                return Err(Refusal::new(Kind::Precondition, Code::LastAdmin));
            }
            let revoked = Some(Act::new(by.name(), now.0));
            let token = TokenRecord { revoked, ..token.clone() };
            let mut item = decided(&token, Some(*at), by, "token.revoked", note("token.revoke", &token));
            if let Some((name, at)) = view.names.get(&token.name).filter(|(name, _)| name.token_id == *token_id) {
                item.delete(name.key(), *at, "token_name.free");
            }
            Ok((Some(item), token))
        })
        .await
}

/// Whether it may administer the site, now.
pub fn administers(token: &TokenRecord, now: Utc) -> bool {
    let gives = |grant: &Grant| grant.role.permits(Permission::Administer) && grant.scope == Scope::Site;
    token.revoked.is_none()
        && token.expires_unix_ms > now.0
        && token.grants.iter().filter_map(HeldGrant::known).any(gives)
}

/// All of them, newest first, with keys that rise in that order.
pub fn newest_first(view: &View) -> Vec<(String, TokenRecord)> {
    let key = |token: &TokenRecord| format!("{:020}{}", i64::MAX - token.created_unix_ms, token.token_id);
    let mut all: Vec<_> = view.tokens.values().map(|(token, _)| (key(token), token.clone())).collect();
    all.sort_by(|(a, _), (b, _)| a.cmp(b));
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::SiteId;
    use midshift_core::time::{Clock, ScaledClock};
    use midshift_store::{CommitError, MemoryStore, Store, StoreId};

    #[tokio::test]
    async fn two_processes_that_make_a_token_of_one_name_at_once_collide_on_the_row_of_the_name() {
        let clock: Arc<dyn Clock> = Arc::new(ScaledClock::new(|| 0, Utc(1_000_000), 1000));
        let site = SiteId::parse("north").expect("a site");
        let store: Arc<dyn Store> = Arc::new(MemoryStore::new(site, StoreId("store-1".into()), clock.clone()));
        let processes = [0, 1].map(|_| Register::new(store.clone(), clock.clone()));
        let (by, now) = (Actor::from("anna"), clock.now().wall);
        let mut items = Vec::new();
        for register in &processes {
            let record = everything().record(&draw(), &by, now);
            // Both look before either of them writes.
            items.push(register.ask(|view| created(view, &record, &by)).await.expect("rows"));
        }
        let mut results = Vec::new();
        for item in items {
            results.extend(store.commit(vec![item]).await);
        }
        assert!(results[0].is_ok() && matches!(results[1], Err(CommitError::Conflict { .. })), "{results:?}");
        let refused = create(&processes[1], &everything(), &by, now).await.map(drop).expect_err("it looks again");
        assert_eq!((refused.kind(), refused.reason.code), (Kind::AlreadyExists, Code::TokenNameTaken));
    }
}
