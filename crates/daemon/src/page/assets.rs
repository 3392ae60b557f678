//! The files of the page, compiled in: nothing is read at run time, and no other host is asked.

use axum::Router;
use axum::http::{HeaderValue, header};
use axum::response::IntoResponse;
use axum::routing::get;

use super::Shared;

/// A browser asks again each time, so that page and service are of one version.
const CACHE: &str = "no-cache";

struct Asset {
    path: &'static str,
    kind: &'static str,
    text: &'static str,
}

macro_rules! asset {
    ($path:literal, $file:literal, $kind:literal) => {
        Asset { path: $path, kind: $kind, text: include_str!(concat!("../../page/", $file)) }
    };
}

const ASSETS: [Asset; 12] = [
    asset!("/", "index.html", "text/html; charset=utf-8"),
    asset!("/page.css", "page.css", "text/css; charset=utf-8"),
    asset!("/icon.svg", "icon.svg", "image/svg+xml"),
    asset!("/page.js", "page.js", "text/javascript; charset=utf-8"),
    asset!("/api.js", "api.js", "text/javascript; charset=utf-8"),
    asset!("/calibration.js", "calibration.js", "text/javascript; charset=utf-8"),
    asset!("/chart.js", "chart.js", "text/javascript; charset=utf-8"),
    asset!("/dom.js", "dom.js", "text/javascript; charset=utf-8"),
    asset!("/picture.js", "picture.js", "text/javascript; charset=utf-8"),
    asset!("/region.js", "region.js", "text/javascript; charset=utf-8"),
    asset!("/state.js", "state.js", "text/javascript; charset=utf-8"),
    asset!("/teach.js", "teach.js", "text/javascript; charset=utf-8"),
];

pub(crate) fn routes() -> Router<Shared> {
    ASSETS.iter().fold(Router::new(), |router, asset| {
        router.route(
            asset.path,
            get(async || {
                let kind = (header::CONTENT_TYPE, HeaderValue::from_static(asset.kind));
                ([kind, (header::CACHE_CONTROL, HeaderValue::from_static(CACHE))], asset.text).into_response()
            }),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_other_host_is_asked_and_nothing_stands_inline() {
        for Asset { path, text, .. } in &ASSETS {
            for address in ["http://", "https://", "//cdn"] {
                // Names of XML are no addresses.
                let text = text.replace("http://www.w3.org/", "");
                assert!(!text.contains(address), "{path} asks another host");
            }
        }
        let page = ASSETS[0].text;
        for inline in ["<style", " style=", " onclick=", " onload=", "javascript:"] {
            assert!(!page.contains(inline), "{inline} is refused by the page's own policy");
        }
        for script in page.split("<script").skip(1) {
            assert!(script.split('>').next().unwrap().contains("src="), "an inline script is refused");
        }
    }

    #[test]
    fn every_module_that_is_imported_is_served() {
        for Asset { path, text, .. } in ASSETS.iter().filter(|asset| asset.path.ends_with(".js")) {
            for import in text.lines().filter_map(|line| line.split_once(" from \"./")?.1.split('"').next()) {
                assert!(ASSETS.iter().any(|asset| asset.path == format!("/{import}")), "{path} imports {import}");
            }
        }
    }
}
