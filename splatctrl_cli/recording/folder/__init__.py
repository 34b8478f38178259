"""Folders of colour and depth: known layouts, described ones, DTU and IDR."""
