"""Other people's folders of colour and depth: known layouts, described ones, DTU and IDR scans."""
