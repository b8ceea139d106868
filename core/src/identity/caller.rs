//! Identifies the caller of a request, and decides what it may do.

use super::grant::{Access, Grant, HeldGrant, Permission, Scope};
use super::token::{Digest, TokenId};
use crate::ids::{AreaId, RobotId};
use crate::reason::{Code, Kind, Reason, Refusal};
use std::fmt;
use std::sync::Arc;

/// The identity of a caller, before any of its rights.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Principal {
    /// A caller without a certificate and without a token.
    Nobody,
    /// A caller of a port without login (`dev`), or code of the same process: it may do everything.
    Local,
    /// A robot, by its certificate.
    Robot(RobotId),
    /// A person or a program, by a token.
    Holder {
        /// Id of the token.
        token: TokenId,
        /// Name of the holder, under which its decisions are recorded.
        name: Arc<str>,
    },
}

/// The caller of a request, with its rights. Stands in the extensions of each request that came through a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Caller {
    principal: Principal,
    grants: Arc<[HeldGrant]>,
    /// Its token's time is over, for less than [`crate::limits::TOKEN_STOPS_AFTER_EXPIRY`]: it may engage stops and nothing else.
    expired: bool,
    certificate: Option<Arc<str>>,
    key: Option<Digest>,
    person: Option<Arc<str>>,
}

impl Caller {
    /// A caller that showed neither a certificate nor a token.
    pub fn nobody() -> Self {
        Self::without_grants(Principal::Nobody)
    }
    /// A caller that may do everything.
    pub fn local() -> Self {
        Self::without_grants(Principal::Local)
    }
    /// A robot.
    pub fn robot(robot_id: RobotId) -> Self {
        Self::without_grants(Principal::Robot(robot_id))
    }
    fn without_grants(principal: Principal) -> Self {
        Self { principal, grants: Arc::default(), expired: false, certificate: None, key: None, person: None }
    }
    /// The same with the serial number of the certificate that it showed, in hex.
    #[must_use]
    pub fn with_certificate(self, serial: Option<Arc<str>>) -> Self {
        Self { certificate: serial, ..self }
    }
    /// The same with the digest of the public key of its certificate.
    #[must_use]
    pub fn with_key(self, key: Digest) -> Self {
        Self { key: Some(key), ..self }
    }
    /// The holder of a token; of one that is `expired`, it may still engage stops.
    pub fn holder(token: TokenId, name: Arc<str>, grants: Arc<[HeldGrant]>, expired: bool) -> Self {
        Self { grants, expired, ..Self::without_grants(Principal::Holder { token, name }) }
    }
    /// The same as one person's, who may have several tokens. None: its name stands for itself.
    #[must_use]
    pub fn with_person(self, person: Option<Arc<str>>) -> Self {
        Self { person, ..self }
    }
    /// The person that its token was made for; none: none was named.
    pub const fn named_person(&self) -> Option<&Arc<str>> {
        self.person.as_ref()
    }
    /// The person of its token, else its own name. Two callers are compared by it where a second person is asked for.
    pub fn person(&self) -> String {
        self.person.as_ref().map_or_else(|| self.to_string(), ToString::to_string)
    }
    /// Its identity, without its rights.
    pub const fn principal(&self) -> &Principal {
        &self.principal
    }
    /// Serial number of the certificate that it showed, in hex; none: it showed none.
    pub const fn certificate(&self) -> Option<&Arc<str>> {
        self.certificate.as_ref()
    }
    /// Digest of the public key of its certificate; none: it showed none.
    pub const fn key(&self) -> Option<&Digest> {
        self.key.as_ref()
    }
    /// Whether its token's time is over: it may engage stops and nothing else.
    pub const fn is_expired(&self) -> bool {
        self.expired
    }
    /// Its grants.
    pub fn grants(&self) -> &[HeldGrant] {
        &self.grants
    }
    fn known_grants(&self) -> impl Iterator<Item = &Grant> {
        self.grants.iter().filter_map(HeldGrant::known)
    }

    /// Whether a method with this rule is for it at all, somewhere. Of what it may be asked is held against [`Caller::is_permitted_in`] where the object is known;
    /// a method of the whole site is decided here.
    ///
    /// # Errors
    /// Not signed in, or no grant that permits it.
    pub fn may_call(&self, access: Access) -> Result<(), Refusal> {
        let permission = access.permission;
        let allowed = match (&self.principal, permission) {
            (_, Permission::Anybody) | (Principal::Local, _) => true,
            (Principal::Robot(_), needed) => matches!(needed, Permission::Robot | Permission::SignedIn),
            (Principal::Nobody, _) => return Err(Refusal::new(Kind::Unauthenticated, Code::SignInNeeded)),
            (Principal::Holder { .. }, Permission::Stop) => !self.grants.is_empty(),
            (Principal::Holder { .. }, _) if self.expired => {
                return Err(Refusal::new(Kind::Unauthenticated, Code::TokenExpired));
            }
            (Principal::Holder { .. }, needed) => self.known_grants().any(|grant| {
                grant.role.permits(needed) && (access.object != super::Object::Site || grant.scope == Scope::Site)
            }),
        };
        if allowed { Ok(()) } else { Err(self.denied(permission)) }
    }

    /// Whether it may do that to something that lies in these areas: each of them must be in the scope of a grant that permits it, and something without any
    /// area is the site's.
    pub fn is_permitted_in<'a>(&self, permission: Permission, areas: impl IntoIterator<Item = &'a AreaId>) -> bool {
        if matches!(self.principal, Principal::Local) {
            return true;
        }
        let permits = |area: Option<&AreaId>| {
            self.known_grants().any(|grant| {
                grant.role.permits(permission) && area.map_or(grant.scope == Scope::Site, |area| grant.scope.has(area))
            })
        };
        let mut areas = areas.into_iter().peekable();
        match areas.peek() {
            None => permits(None),
            Some(_) => areas.all(|area| permits(Some(area))),
        }
    }

    /// As [`Caller::is_permitted_in`], as an answer.
    ///
    /// # Errors
    /// It may not.
    pub fn authorize<'a>(
        &self,
        permission: Permission,
        areas: impl IntoIterator<Item = &'a AreaId>,
    ) -> Result<(), Refusal> {
        if self.is_permitted_in(permission, areas) { Ok(()) } else { Err(self.denied(permission)) }
    }

    /// Whether it may do that everywhere: where something lies does not matter then.
    pub fn is_permitted_everywhere(&self, permission: Permission) -> bool {
        self.is_permitted_in(permission, [])
    }

    /// Whether it may do that to something that is there and lies in these areas. What it may not even see is `missing` to it.
    ///
    /// # Errors
    /// It may not see it, or sees it and may not do that.
    pub fn authorize_visible<'a>(
        &self,
        permission: Permission,
        areas: impl IntoIterator<Item = &'a AreaId> + Copy,
        missing: impl FnOnce() -> Refusal,
    ) -> Result<(), Refusal> {
        if self.is_permitted_in(Permission::Read, areas) { self.authorize(permission, areas) } else { Err(missing()) }
    }

    /// Whether it is this robot, or one for whom robots' own calls are open.
    ///
    /// # Errors
    /// It is somebody else.
    pub fn is_robot(&self, robot_id: &RobotId) -> Result<(), Refusal> {
        match &self.principal {
            Principal::Local => Ok(()),
            Principal::Robot(own) if own == robot_id => Ok(()),
            Principal::Nobody => Err(Refusal::new(Kind::Unauthenticated, Code::SignInNeeded)),
            _ => Err(Refusal::new(
                Kind::Denied,
                Reason::new(Code::NotThisRobot, format!("{self} may not speak for {robot_id}"))
                    .with("robot_id", robot_id),
            )),
        }
    }

    fn denied(&self, permission: Permission) -> Refusal {
        let reason = Reason::new(Code::NotPermitted, format!("{self} may not: it needs {permission:?}"));
        Refusal::new(Kind::Denied, reason.with("permission", format!("{permission:?}").to_uppercase()))
    }
}

/// As an actor: what decisions are recorded under.
impl fmt::Display for Caller {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.principal {
            Principal::Nobody => f.write_str("nobody"),
            Principal::Local => f.write_str("anonymous"),
            Principal::Robot(robot_id) => write!(f, "robot:{robot_id}"),
            Principal::Holder { name, .. } => f.write_str(name),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::grant::Object;
    use super::*;
    use crate::overload::Class;

    fn area(name: &str) -> AreaId {
        AreaId::parse(name).expect("an area")
    }

    fn holder(grants: &[&str]) -> Caller {
        let grants = grants.iter().map(|grant| HeldGrant::from((*grant).to_owned())).collect();
        Caller::holder(TokenId::new("t1").expect("an id"), "anna".into(), grants, false)
    }

    fn rule(permission: Permission, object: Object) -> Access {
        Access { permission, object, class: Class::Control }
    }

    #[test]
    fn a_role_in_one_area_and_another_role_in_another_are_never_merged() {
        let caller = holder(&["operator@packing", "viewer@storage"]);
        assert!(caller.is_permitted_in(Permission::Operate, [&area("packing")]));
        assert!(!caller.is_permitted_in(Permission::Operate, [&area("storage")]));
        assert!(caller.is_permitted_in(Permission::Read, [&area("packing"), &area("storage")]));
        assert!(!caller.is_permitted_in(Permission::Operate, [&area("packing"), &area("storage")]));
        assert!(!caller.is_permitted_in(Permission::Read, []), "what lies nowhere is the site's");
        assert!(holder(&["viewer"]).is_permitted_in(Permission::Read, []));
    }

    #[test]
    fn what_a_caller_may_not_see_is_missing_to_it_and_what_it_sees_is_denied() {
        let caller = holder(&["operator@packing", "viewer@storage"]);
        let acts = |name: &str| {
            let missing = || Refusal::new(Kind::NotFound, Code::TaskNotFound);
            caller.authorize_visible(Permission::Operate, [&area(name)], missing).map_err(|refusal| refusal.kind())
        };
        assert_eq!(["packing", "storage", "yard"].map(acts), [Ok(()), Err(Kind::Denied), Err(Kind::NotFound)]);
        assert!(!caller.is_permitted_everywhere(Permission::Read));
        assert!(
            holder(&["viewer"]).is_permitted_everywhere(Permission::Read)
                && Caller::local().is_permitted_everywhere(Permission::Reset)
        );
    }

    #[test]
    fn a_grant_of_a_newer_version_permits_nothing_but_to_stop() {
        let scanner = holder(&["scanner", "viewer@wall:7 8"]);
        assert_eq!(scanner.grants()[1].to_string(), "viewer@wall:7 8", "it is kept as it was");
        assert!(scanner.may_call(rule(Permission::Read, Object::List)).is_err());
        assert!(!scanner.is_permitted_in(Permission::Read, &[area("packing")]));
        assert!(scanner.may_call(rule(Permission::Stop, Object::None)).is_ok());
    }

    #[test]
    fn what_is_asked_of_the_site_needs_a_grant_of_the_site() {
        let site = rule(Permission::Administer, Object::Site);
        assert!(holder(&["admin"]).may_call(site).is_ok());
        let refused = holder(&["admin@packing"]).may_call(site).expect_err("an area is not the site");
        assert_eq!((refused.kind(), refused.reason.code), (Kind::Denied, Code::NotPermitted));
    }

    #[test]
    fn nobody_is_asked_to_sign_in_and_a_robot_does_nothing_that_is_for_people() {
        let read = rule(Permission::Read, Object::List);
        assert_eq!(Caller::nobody().may_call(read).expect_err("nobody").kind(), Kind::Unauthenticated);
        let robot = Caller::robot(RobotId::parse("r7").expect("an id"));
        assert_eq!(robot.may_call(read).expect_err("a robot").kind(), Kind::Denied);
        assert!(robot.may_call(rule(Permission::Robot, Object::Robot)).is_ok());
        assert!(holder(&["admin"]).may_call(rule(Permission::Robot, Object::Robot)).is_err());
        assert!(Caller::nobody().may_call(rule(Permission::Anybody, Object::None)).is_ok());
    }

    #[test]
    fn a_robot_speaks_for_itself_alone() {
        let [own, other] = ["r7", "r8"].map(|id| RobotId::parse(id).expect("an id"));
        let robot = Caller::robot(own.clone());
        assert!(robot.is_robot(&own).is_ok());
        assert_eq!(robot.is_robot(&other).expect_err("another").reason.code, Code::NotThisRobot);
        assert_eq!(holder(&["admin"]).is_robot(&own).expect_err("a person").kind(), Kind::Denied);
    }

    #[test]
    fn a_token_whose_time_is_over_still_stops_and_does_nothing_else() {
        let grants: Arc<[HeldGrant]> = Arc::from(["stop-resetter".to_owned().into()]);
        let late = Caller::holder(TokenId::new("t1").expect("an id"), "anna".into(), grants, true);
        assert!(late.may_call(rule(Permission::Stop, Object::None)).is_ok());
        let refused = late.may_call(rule(Permission::Reset, Object::None)).expect_err("late");
        assert_eq!(refused.reason.code, Code::TokenExpired);
        assert!(late.may_call(rule(Permission::SignedIn, Object::None)).is_err());
    }
}
