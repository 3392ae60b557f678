//! Who may ask: a check of every request before anything is done for it.
//!
//! * The request must name this machine (`Host`): an address, `localhost`, or a name of `[http] hosts`. A page of somebody else's,
//!   whose name is made to point here, cannot read anything (DNS rebinding): 421.
//! * A page of another origin may neither ask nor embed anything (`Origin`, `Sec-Fetch-Site`): 403.
//! * What changes something, which is everything but GET and HEAD, needs the operator's token: 401. Browsers never send it by
//!   themselves.

use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::Shared;
use super::answer::Failure;

const FETCH_SITE: &str = "sec-fetch-site";
const FETCH_MODE: &str = "sec-fetch-mode";

/// Nothing from elsewhere, nothing inline, and in nobody's frame.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Lets a request through or answers it.
pub(crate) async fn check(State(shared): State<Shared>, request: Request, next: Next) -> Response {
    let mut response = match refusal(&shared, &request) {
        Some(failure) => failure.into_response(),
        None => next.run(request).await,
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    response
}

fn refusal(shared: &Shared, request: &Request<Body>) -> Option<Failure> {
    let headers = request.headers();
    let host = match host(headers) {
        Ok(host) if is_ours(&host, shared.hosts()) => host,
        Ok(host) => {
            return Some(Failure::new(
                StatusCode::MISDIRECTED_REQUEST,
                format!(
                    "host {:?} is not known here; use an address or localhost, or name it in [http] hosts",
                    host.host()
                ),
            ));
        }
        Err(failure) => return Some(failure),
    };
    if let Some(failure) = foreign(headers, &host) {
        return Some(failure);
    }
    let is_read = [Method::GET, Method::HEAD].contains(request.method());
    if !is_read && !is_authorized(headers, shared) {
        let text = "the operator's token is missing or wrong; it is in the file that the log of samsodd names";
        return Some(Failure::new(StatusCode::UNAUTHORIZED, text.to_owned()));
    }
    None
}

/// Whom the request is for.
fn host(headers: &HeaderMap) -> Result<Authority, Failure> {
    let fail = |text: &str| Failure::new(StatusCode::BAD_REQUEST, text.to_owned());
    let mut hosts = headers.get_all(header::HOST).iter();
    match (hosts.next(), hosts.next()) {
        (Some(host), None) => {
            let host = Authority::try_from(host.as_bytes()).ok().filter(|host| !host.as_str().contains('@'));
            host.ok_or_else(|| fail("the header Host names no host"))
        }
        _ => Err(fail("there must be one header Host")),
    }
}

fn is_ours(host: &Authority, names: &[String]) -> bool {
    let name = host.host();
    let address = name.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(name);
    // Nobody can make an address point elsewhere.
    address.parse::<std::net::IpAddr>().is_ok()
        || name.eq_ignore_ascii_case("localhost")
        || names.iter().any(|known| name.eq_ignore_ascii_case(known))
}

/// Why a page of another origin gets nothing.
fn foreign(headers: &HeaderMap, host: &Authority) -> Option<Failure> {
    let fail = |text: String| Some(Failure::new(StatusCode::FORBIDDEN, text));
    for origin in headers.get_all(header::ORIGIN) {
        let origin = origin.to_str().unwrap_or("?");
        let authority = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
        if !authority.is_some_and(|authority| authority.eq_ignore_ascii_case(host.as_str())) {
            return fail(format!("pages of {origin} may not ask here"));
        }
    }
    let text = |name: &str| headers.get(name).and_then(|value| value.to_str().ok()).unwrap_or_default();
    // A link to the page may stand anywhere; what it shows may not be embedded.
    let is_foreign = ["cross-site", "same-site"].contains(&text(FETCH_SITE));
    if is_foreign && text(FETCH_MODE) != "navigate" {
        return fail("other pages may not embed what is here".to_owned());
    }
    None
}

fn is_authorized(headers: &HeaderMap, shared: &Shared) -> bool {
    let value = headers.get(header::AUTHORIZATION).and_then(|value| value.to_str().ok()).unwrap_or_default();
    let Some((scheme, token)) = value.split_once(' ') else { return false };
    scheme.eq_ignore_ascii_case("bearer") && shared.token().is(token.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn authority(text: &str) -> Authority {
        text.parse().unwrap()
    }

    #[test]
    fn addresses_localhost_and_given_names_are_ours_and_nothing_else() {
        let names = ["cell3.example".to_owned()];
        for host in ["127.0.0.1:9464", "10.0.0.7", "[::1]:9464", "LOCALHOST:1", "localhost", "Cell3.example:9464"] {
            assert!(is_ours(&authority(host), &names), "{host}");
        }
        for host in ["evil.example:9464", "localhost.evil.example", "127.0.0.1.evil.example", "cell3.example.evil"] {
            assert!(!is_ours(&authority(host), &names), "{host}");
        }
    }

    #[test]
    fn another_origin_is_foreign_and_so_is_none() {
        let host = authority("127.0.0.1:9464");
        let with = |pairs: &[(&'static str, &'static str)]| {
            let mut headers = HeaderMap::new();
            for (name, value) in pairs {
                headers.append(*name, HeaderValue::from_static(value));
            }
            foreign(&headers, &host).is_some()
        };
        assert!(!with(&[]) && !with(&[("origin", "http://127.0.0.1:9464")]));
        assert!(with(&[("origin", "http://127.0.0.1:9465")]), "another port");
        assert!(with(&[("origin", "null")]) && with(&[("origin", "http://evil.example")]));
        assert!(with(&[("origin", "http://127.0.0.1:9464"), ("origin", "http://evil.example")]), "any of them");
        assert!(with(&[(FETCH_SITE, "cross-site"), (FETCH_MODE, "no-cors")]), "an image of another page");
        assert!(!with(&[(FETCH_SITE, "cross-site"), (FETCH_MODE, "navigate")]), "a link of another page");
        assert!(!with(&[(FETCH_SITE, "same-origin"), (FETCH_MODE, "cors")]));
    }

    #[test]
    fn a_request_names_one_host_and_no_user() {
        let of = |hosts: &[&'static str]| {
            let mut headers = HeaderMap::new();
            for host in hosts {
                headers.append(header::HOST, HeaderValue::from_static(host));
            }
            host(&headers).map(|host| host.to_string()).ok()
        };
        assert_eq!(of(&["127.0.0.1:80"]).as_deref(), Some("127.0.0.1:80"));
        for hosts in [&[][..], &["a", "a"], &["a@127.0.0.1"], &["not a host"], &[""]] {
            assert_eq!(of(hosts), None, "{hosts:?}");
        }
    }
}
