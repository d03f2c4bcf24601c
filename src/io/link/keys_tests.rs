//! Tests of the certificate authority.

use super::*;

/// 2026-11-19T00:00:00Z.
const NOW: UtcTime = UtcTime::from_unix_ns(1_795_046_400_000_000_000);

fn authority() -> (tempfile::TempDir, Authority) {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let authority = Authority::at(dir.path().join("keys"));
    authority.create("field team", 3_650, NOW).expect("an authority");
    (dir, authority)
}

#[test]
fn a_member_carries_role_name_and_expiry() {
    let (_dir, authority) = authority();
    let (pem, key) = authority.issue(Role::Payload, "Alpha", 30, NOW).expect("a payload");
    assert_eq!(peer_of(&read_der(&pem).expect("a certificate")), Some((Role::Payload, "alpha".into())));
    let mode = std::fs::metadata(&key).expect("a key file").permissions().mode() & 0o777;
    assert_eq!(mode, 0o600);
    let members = authority.members().expect("members");
    assert_eq!(members.len(), 1);
    assert_eq!(members[0].expires, UtcTime::from_unix_ns(NOW.unix_ns() + 30 * 86_400 * NS_PER_S));
    assert!(!members[0].revoked);
}

#[test]
fn revoked_members_are_on_the_list_and_the_list_grows() {
    let (_dir, authority) = authority();
    for name in ["one", "two", "three"] {
        authority.issue(Role::Station, name, 30, NOW).expect("a station");
    }
    authority.revoke(Role::Station, "one", NOW).expect("revoked");
    authority.revoke(Role::Station, "three", NOW).expect("revoked");
    authority.revoke(Role::Station, "three", NOW).expect("revoking twice is revoking once");
    let revoked: Vec<_> =
        authority.members().expect("members").into_iter().map(|m| (m.name, m.revoked)).collect();
    assert_eq!(revoked, [("one".to_owned(), true), ("three".to_owned(), true), ("two".to_owned(), false)]);
    assert_eq!(authority.revoked_serials().expect("a list").len(), 2);
}

#[test]
fn nothing_is_overwritten_and_names_are_checked() {
    let (_dir, authority) = authority();
    assert!(matches!(authority.create("again", 1, NOW), Err(KeyError::Exists(_))));
    authority.issue(Role::Payload, "a", 1, NOW).expect("a payload");
    assert!(matches!(authority.issue(Role::Payload, "a", 1, NOW), Err(KeyError::Exists(_))));
    for bad in ["", "a/b", "..", "-a", "a.b", &"x".repeat(41)] {
        assert!(matches!(authority.issue(Role::Payload, bad, 1, NOW), Err(KeyError::Name(_))), "{bad:?}");
    }
}

#[test]
fn loose_private_keys_are_refused() {
    let (_dir, authority) = authority();
    let key = authority.key_file();
    std::fs::set_permissions(&key, std::fs::Permissions::from_mode(0o640)).expect("chmod");
    let error = authority.issue(Role::Payload, "a", 1, NOW).expect_err("an open key");
    assert!(matches!(error, KeyError::Loose { mode: 0o640, .. }), "{error}");
}

#[test]
fn a_clock_that_was_never_set_makes_no_certificates() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let error = Authority::at(dir.path()).create("x", 10, UtcTime::from_unix_ns(0)).expect_err("1970");
    assert!(matches!(error, KeyError::ClockNotSet(_)));
}

proptest::proptest! {
    #[test]
    fn any_bytes_are_no_certificate_and_no_panic(
        bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..400),
    ) {
        proptest::prop_assert_eq!(peer_of(&bytes), None);
        proptest::prop_assert_eq!(serial_of(&bytes), None);
        proptest::prop_assert_eq!(expiry_of(&bytes), None);
        // An empty list could occur by chance; only a panic is an error here.
        let _ = serials_of_list(&bytes);
    }
}
