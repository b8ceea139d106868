//! Tokens of people and programs: made, listed, taken back.

use crate::register::{Register, View, decided};
use midshift_core::audit::Note;
use midshift_core::identity::{Act, Digest, Grant, Permission, Role, Scope, Secret, TokenId, TokenRecord};
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rows::Writer;
use midshift_core::time::{LinkDuration, Utc};
use sha2::Digest as _;

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

/// What a token is to be.
#[derive(Clone, Debug)]
pub struct Wanted {
    /// Who it stands for.
    pub name: String,
    /// Its rights.
    pub grants: Vec<Grant>,
    /// How long.
    pub valid: LinkDuration,
}

impl Wanted {
    /// Checks what was asked for.
    ///
    /// # Errors
    /// Each broken rule.
    pub fn check(name: &str, grants: &[String], valid_seconds: u64) -> Result<Self, Refusal> {
        let mut bad = Violations::default();
        let is_fit = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-_.@".contains(c);
        if name.is_empty() || name.len() > NAME_MAX || !name.chars().all(is_fit) {
            bad.add("name", "must be 1-64 of [a-z0-9-_.@]");
        } else if RESERVED.contains(&name) || Writer::ALL.iter().any(|service| service.as_str() == name) {
            bad.add("name", "stands for midshift itself in the audit, or for nobody: choose another");
        }
        if grants.is_empty() || grants.len() > limits::GRANTS_MAX {
            bad.add("grants", format!("must be 1-{}: what it may do", limits::GRANTS_MAX));
        }
        let read = |(n, text): (usize, &String)| {
            let (field, grant) = (format!("grants[{n}]"), text.parse::<Grant>());
            let grant = bad.take(&field, grant)?;
            if matches!(grant, Grant { role: Role::Admin | Role::Auditor, scope: Scope::Area(_) }) {
                let role = grant.role.as_str();
                bad.add(field, format!("{grant} permits no more than viewer does: {role} is of the whole site"));
            }
            Some(grant)
        };
        let grants: Vec<Grant> = grants.iter().enumerate().filter_map(read).collect();
        let days = DAY.as_ms() / 1000..=limits::TOKEN_VALID_MAX.as_ms() / 1000;
        if !days.contains(&valid_seconds) {
            bad.add("valid_seconds", "must be 86400..31622400: 1 to 366 days");
        }
        bad.finish()?;
        Ok(Self { name: name.to_owned(), grants, valid: LinkDuration::from_secs(valid_seconds) })
    }

    fn record(&self, secret: &Secret, actor: &str, now: Utc) -> TokenRecord {
        TokenRecord {
            token_id: secret.id().clone(),
            name: self.name.clone(),
            digest: digest(secret),
            grants: self.grants.clone(),
            created_unix_ms: now.0,
            created_by: actor.to_owned(),
            expires_unix_ms: now.0.saturating_add_unsigned(self.valid.as_ms()),
            revoked: None,
        }
    }
}

fn everything() -> Wanted {
    let site = |role| Grant { role, scope: Scope::Site };
    let roles = [Role::Admin, Role::Operator, Role::OtaAuthor, Role::OtaApprover, Role::StopResetter, Role::Auditor];
    Wanted { name: FIRST.to_owned(), grants: roles.map(site).into(), valid: limits::TOKEN_VALID_MAX }
}

fn note(action: &'static str, token: &TokenRecord) -> Note {
    Note::new(action).about("token", &token.token_id).with("name", &token.name)
}

fn made_note(token: &TokenRecord) -> Note {
    let grants: Vec<String> = token.grants.iter().map(ToString::to_string).collect();
    note("token.create", token).with("grants", grants.join(" "))
}

/// The first token of a site; none if there ever was one.
pub async fn first(register: &Register, now: Utc) -> Result<Option<Secret>, Refusal> {
    let secret = draw();
    let record = everything().record(&secret, "midshift", now);
    let made = register.decide(|view| match view.tokens.is_empty() {
        true => Ok((Some(decided(&record, None, "midshift", "token.created", made_note(&record))), true)),
        false => Ok((None, false)),
    });
    Ok(made.await?.then_some(secret))
}

/// Another token that may do everything.
pub async fn spare(register: &Register, now: Utc) -> Result<Secret, Refusal> {
    let secret = draw();
    let record = everything().record(&secret, "midshift", now);
    register
        .decide(|_| Ok((Some(decided(&record, None, "midshift", "token.created", made_note(&record))), ())))
        .await?;
    Ok(secret)
}

/// A new token.
pub async fn create(
    register: &Register,
    wanted: &Wanted,
    actor: &str,
    now: Utc,
) -> Result<(TokenRecord, Secret), Refusal> {
    let secret = draw();
    let record = wanted.record(&secret, actor, now);
    register
        .decide(|view| {
            let live = view.tokens.values().filter(|(token, _)| token.revoked.is_none()).count();
            if live >= limits::TOKENS_MAX {
                let text = format!("the site has {live} tokens that were not revoked: revoke those that nobody uses");
                return Err(Refusal::new(Kind::Exhausted, Reason::new(Code::Overloaded, text)));
            }
            Ok((Some(decided(&record, None, actor, "token.created", made_note(&record))), ()))
        })
        .await?;
    Ok((record, secret))
}

/// Takes one back.
pub async fn revoke(register: &Register, token_id: &TokenId, actor: &str, now: Utc) -> Result<TokenRecord, Refusal> {
    let not_found = || Refusal::new(Kind::NotFound, Reason::from(Code::TokenNotFound).with("token_id", token_id));
    let asked = Note::new("token.revoke").about("token", token_id);
    register
        .decide_for(actor, asked, |view| {
            let (token, at) = view.tokens.get(token_id).ok_or_else(not_found)?;
            if token.revoked.is_some() {
                return Ok((None, token.clone()));
            }
            if administers(token, now)
                && !view.tokens.values().any(|(t, _)| t.token_id != *token_id && administers(t, now))
            {
                return Err(Refusal::new(Kind::Precondition, Code::LastAdmin));
            }
            let revoked = Some(Act::new(actor, now.0));
            let token = TokenRecord { revoked, ..token.clone() };
            Ok((Some(decided(&token, Some(*at), actor, "token.revoked", note("token.revoke", &token))), token))
        })
        .await
}

fn administers(token: &TokenRecord, now: Utc) -> bool {
    let gives = |grant: &Grant| grant.role.permits(Permission::Administer) && grant.scope == Scope::Site;
    token.revoked.is_none() && token.expires_unix_ms > now.0 && token.grants.iter().any(gives)
}

/// All of them, newest first, with keys that rise in that order.
pub fn newest_first(view: &View) -> Vec<(String, TokenRecord)> {
    let key = |token: &TokenRecord| format!("{:020}{}", i64::MAX - token.created_unix_ms, token.token_id);
    let mut all: Vec<_> = view.tokens.values().map(|(token, _)| (key(token), token.clone())).collect();
    all.sort_by(|(a, _), (b, _)| a.cmp(b));
    all
}
