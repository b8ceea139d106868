//! Roles, what each of them permits, and where a grant of one holds.

use crate::ids::AreaId;
use crate::overload::Class;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// What somebody may be allowed to do. The wire names them in `midshift.common.v1.Permission`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Permission {
    /// Nobody needs to be known.
    Anybody,
    /// A robot, for itself alone.
    Robot,
    /// Anyone known: a person or a program by its token, a robot by its certificate.
    SignedIn,
    /// See robots, tasks, roll-outs, stops.
    Read,
    /// Bring tasks in and take them back.
    Dispatch,
    /// Take robots out of work and give them back, clear places, answer for tasks, change rules of areas.
    Operate,
    /// Bring software, plan and run roll-outs.
    Author,
    /// Approve roll-outs that somebody else wrote.
    Approve,
    /// Write a roll-out down that reaches many robots at once, without a small wave before them.
    Push,
    /// Engage a stop, and see what is stopped.
    Stop,
    /// Reset a stop.
    Reset,
    /// Give and take rights, enrol and replace robots.
    Administer,
    /// Read who did what.
    Audit,
}

/// What a method is asked of. The wire names them in `midshift.common.v1.Object`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Object {
    /// Nothing of the site.
    None,
    /// The site as a whole.
    Site,
    /// The areas that the request names.
    Area,
    /// A robot: the area that it stands in.
    Robot,
    /// A task: the areas of its goals.
    Task,
    /// A roll-out: the areas that it is for.
    Rollout,
    /// A place: its area.
    Place,
    /// Many things, of which the caller gets what it may see.
    List,
}

/// The rule of one method.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Access {
    /// What the caller must be allowed to do.
    pub permission: Permission,
    /// Of what.
    pub object: Object,
    /// What is shed first.
    pub class: Class,
}

macro_rules! roles {
    ($($variant:ident $name:literal [$($permission:ident)*], $doc:literal;)*) => {
        /// A role of a person or a program.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Role { $(#[doc = $doc] $variant,)* }
        impl Role {
            /// Every role.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];
            /// Its name, on the wire and for people.
            pub const fn as_str(self) -> &'static str { match self { $(Self::$variant => $name),* } }
            /// What it is for, for people.
            pub const fn help(self) -> &'static str { match self { $(Self::$variant => $doc),* } }
            /// What it permits beside what everybody signed in may do: engage a stop.
            pub const fn permissions(self) -> &'static [Permission] {
                match self { $(Self::$variant => &[$(Permission::$permission),*]),* }
            }
        }
    };
}

roles! {
    Viewer "viewer" [Read], "Sees robots, tasks, roll-outs and stops.";
    Dispatcher "dispatcher" [Read Dispatch], "Brings tasks in and takes them back.";
    Operator "operator" [Read Dispatch Operate], "Takes robots out of work and gives them back, resumes, clears places, changes rules of areas and of the planner.";
    OtaAuthor "ota-author" [Read Author], "Brings software, plans and runs roll-outs.";
    OtaApprover "ota-approver" [Read Approve], "Approves roll-outs that somebody else wrote.";
    OtaFullPush "ota-full-push" [Read Push], "Lets an ota-author write roll-outs that reach many robots at once.";
    StopOnly "stop-only" [], "Engages stops and sees them: for a panel on a wall.";
    StopResetter "stop-resetter" [Read Reset], "Resets stops.";
    Admin "admin" [Read Administer], "Gives and takes rights, enrols and replaces robots.";
    Auditor "auditor" [Read Audit], "Reads who did what.";
}

impl Role {
    /// Whether it permits that. Everybody signed in may stop.
    pub fn permits(self, permission: Permission) -> bool {
        match permission {
            Permission::Anybody | Permission::SignedIn | Permission::Stop => true,
            Permission::Robot => false,
            other => self.permissions().contains(&other),
        }
    }
}

/// Where a grant holds.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Scope {
    /// The whole site, with every area in it.
    Site,
    /// In one area.
    Area(AreaId),
}

impl Scope {
    /// Whether it has the area.
    pub fn has(&self, area: &AreaId) -> bool {
        match self {
            Self::Site => true,
            Self::Area(own) => own == area,
        }
    }
}

/// One role in one scope; as text `operator` or `operator@packing`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Grant {
    /// The role.
    pub role: Role,
    /// The site, or the one area that it holds in.
    pub scope: Scope,
}

/// A grant as rows and ports hold it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub enum HeldGrant {
    /// One that this version knows.
    Known(Grant),
    /// One of a newer version: it permits nothing but to stop here, and is written back as it was.
    Newer(String),
}

impl HeldGrant {
    /// The grant; none: it is of a newer version.
    pub const fn known(&self) -> Option<&Grant> {
        match self {
            Self::Known(grant) => Some(grant),
            Self::Newer(_) => None,
        }
    }
}

impl From<String> for HeldGrant {
    fn from(text: String) -> Self {
        text.parse().map_or(Self::Newer(text), Self::Known)
    }
}

impl From<Grant> for HeldGrant {
    fn from(grant: Grant) -> Self {
        Self::Known(grant)
    }
}

impl From<HeldGrant> for String {
    fn from(grant: HeldGrant) -> Self {
        grant.to_string()
    }
}

impl fmt::Display for HeldGrant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Known(grant) => grant.fmt(f),
            Self::Newer(text) => f.write_str(text),
        }
    }
}

/// A grant that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "must be ROLE or ROLE@AREA with a role of viewer, dispatcher, operator, ota-author, ota-approver, ota-full-push, stop-only, stop-resetter, admin, auditor"
)]
pub struct BadGrant;

impl FromStr for Grant {
    type Err = BadGrant;
    fn from_str(text: &str) -> Result<Self, BadGrant> {
        let (role, area) = text.split_once('@').map_or((text, None), |(role, area)| (role, Some(area)));
        let role = Role::ALL.iter().copied().find(|known| known.as_str() == role).ok_or(BadGrant)?;
        let scope = match area {
            None => Scope::Site,
            Some(area) => Scope::Area(AreaId::parse(area).map_err(|_| BadGrant)?),
        };
        Ok(Self { role, scope })
    }
}

impl TryFrom<String> for Grant {
    type Error = BadGrant;
    fn try_from(text: String) -> Result<Self, BadGrant> {
        text.parse()
    }
}

impl From<Grant> for String {
    fn from(grant: Grant) -> Self {
        grant.to_string()
    }
}

impl fmt::Display for Grant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.scope {
            Scope::Site => f.write_str(self.role.as_str()),
            Scope::Area(area) => write!(f, "{}@{area}", self.role.as_str()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grant_reads_back_from_its_text_and_nothing_else_does() {
        for text in ["operator", "stop-only", "dispatcher@packing"] {
            assert_eq!(text.parse::<Grant>().map(|grant| grant.to_string()).as_deref(), Ok(text));
        }
        for text in ["", "root", "operator@", "operator@a b", "@packing", "Operator"] {
            assert_eq!(text.parse::<Grant>(), Err(BadGrant), "{text}");
        }
    }

    #[test]
    fn the_page_about_security_says_what_each_role_permits() {
        let page = include_str!("../../../docs/security.md");
        let rows = page.lines().filter(|line| line.starts_with("| `") && line.matches('|').count() == 4);
        let expected = Role::ALL.iter().map(|role| {
            let all: Vec<String> = role.permissions().iter().map(|p| format!("{p:?}").to_uppercase()).collect();
            let all = if all.is_empty() { "-".to_owned() } else { all.join(" ") };
            format!("| `{}` | {all} | {} |", role.as_str(), role.help())
        });
        assert_eq!(rows.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
    }

    #[test]
    fn everybody_signed_in_may_stop_and_only_its_own_role_resets() {
        assert!(Role::ALL.iter().all(|role| role.permits(Permission::Stop)));
        let reset: Vec<_> = Role::ALL.iter().filter(|role| role.permits(Permission::Reset)).collect();
        assert_eq!(reset, [&Role::StopResetter]);
    }

    #[test]
    fn no_role_of_a_person_makes_a_robot_of_it() {
        assert!(!Role::ALL.iter().any(|role| role.permits(Permission::Robot)));
    }
}
