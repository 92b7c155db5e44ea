"""The look of the page: light and dark, screen and paper, wide and narrow."""

STYLE = """
:root{color-scheme:light dark;--paper:#fff;--ink:#1d2227;--muted:#5d6670;--line:#d9dde2;--panel:#f5f6f8;
--warn:#8a4b00;--warn-back:#fff4e0;--warn-line:#e3a13a;--good:#1c6b3a;--c1:#1f6fb5;--c2:#c2500e;--c3:#2b8a4b;--c4:#8b4fb3;
--c5:#a3780a;--c6:#c0396b}
@media (prefers-color-scheme:dark){:root{--paper:#15181c;--ink:#e4e7eb;--muted:#a0a8b2;--line:#363c44;--panel:#1e2328;
--warn:#ffce85;--warn-back:#33260f;--warn-line:#a8741f;--good:#7fd49a;--c1:#6db3f2;--c2:#ff9b5e;--c3:#6fd08f;--c4:#cf9df2;
--c5:#e3bd55;--c6:#ff8bb4}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,sans-serif}
main,header,footer{max-width:62rem;margin:0 auto;padding:0 1rem}
h1{font-size:1.7rem;line-height:1.2;margin:1.5rem 0 .3rem}
h2{font-size:1.25rem;margin:2.4rem 0 .6rem;padding-top:.6rem;border-top:1px solid var(--line)}
h3{font-size:1rem;margin:1.4rem 0 .4rem}
p{margin:.5rem 0}
.muted,figcaption,caption{color:var(--muted);font-size:.88rem}
nav ul{display:flex;flex-wrap:wrap;gap:.2rem 1rem;list-style:none;padding:0;margin:.8rem 0}
a{color:var(--c1)}
.distrust{background:var(--warn-back);border:1px solid var(--warn-line);border-radius:.5rem;padding:.2rem 1rem .6rem;
margin:1rem 0}
.distrust h2{border:0;margin:.6rem 0 .2rem;padding:0;color:var(--warn)}
.distrust.clear{background:var(--panel);border-color:var(--line)}
.distrust.clear h2{color:var(--good)}
.distrust li{margin:.35rem 0}
dl.facts{display:grid;grid-template-columns:repeat(auto-fill,minmax(13rem,1fr));gap:.6rem 1.2rem;margin:.8rem 0}
dl.facts div{border-left:3px solid var(--line);padding-left:.6rem}
dl.facts dt{color:var(--muted);font-size:.85rem}
dl.facts dd{margin:0;overflow-wrap:anywhere}
.scroll{overflow-x:auto;margin:.8rem 0}
table{border-collapse:collapse;min-width:min(100%,22rem);font-variant-numeric:tabular-nums;font-size:.9rem}
caption{text-align:left;padding:.2rem 0}
th,td{padding:.25rem .8rem .25rem 0;text-align:right;border-bottom:1px solid var(--line);vertical-align:top}
th:first-child{text-align:left;font-weight:400}
td.text,th.text{text-align:left}
thead th,thead th:first-child{font-weight:600}
figure{margin:1rem 0}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,24rem),1fr));gap:.4rem 1.5rem}
.charts figure{margin:.4rem 0;min-width:0}
svg{width:100%;height:auto;display:block;max-width:40rem}
svg text{fill:var(--ink);font:12.5px system-ui,sans-serif}
svg .tick{fill:var(--muted);font-size:11.5px}
svg .grid{stroke:var(--line);stroke-width:1}
svg .line{fill:none;stroke-width:2;stroke-linejoin:round;stroke-linecap:round}
.legend{display:flex;flex-wrap:wrap;gap:.1rem 1rem;font-size:.88rem;margin:.2rem 0;padding:0;list-style:none}
.legend svg{width:1.8rem;height:.7rem;display:inline-block;vertical-align:middle;margin-right:.4rem}
.swatch{display:inline-block;width:.9rem;height:.9rem;border-radius:.2rem;vertical-align:-.1rem;margin-right:.4rem;
print-color-adjust:exact;-webkit-print-color-adjust:exact}
img{max-width:100%;height:auto;display:block;border-radius:.2rem}
.strip{display:grid;grid-template-columns:repeat(var(--columns),minmax(6.5rem,1fr));gap:.25rem;overflow-x:auto;padding-bottom:.3rem}
.strip figure{margin:0}
.strip figcaption{font-size:.78rem}
.maps{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,22rem),1fr));gap:.8rem}
.maps figure{margin:0}
.colorbar{display:flex;align-items:center;gap:.6rem;font-size:.85rem;margin:.5rem 0}
.colorbar .bar{flex:0 1 12rem;min-width:3rem;height:.8rem;border-radius:.2rem;print-color-adjust:exact;
-webkit-print-color-adjust:exact}
details{margin:.6rem 0}
summary{cursor:pointer}
code{font-size:.88em;overflow-wrap:anywhere}
footer{margin:3rem auto 2rem;border-top:1px solid var(--line);padding-top:.8rem}
@media print{:root{color-scheme:light;--paper:#fff;--ink:#000;--muted:#444;--line:#bbb;--panel:#fff;--warn:#5d3300;
--warn-back:#fff;--warn-line:#000}
body{font-size:10.5pt}nav{display:none}figure,table,.distrust{break-inside:avoid}h2,h3{break-after:avoid}
.scroll,.strip{overflow:visible}}
"""
