"""Acquisition, entrainment, campaigns, run store, service and command line. What is where:

samples         `acquire`, `oversample`, `decimate`, `two_microphones`, `calibration`
entrainment     `lockin`, `tongue`, `coupling`, `entrain` (pure), `conduct` (the loop around it)
campaigns       `plan`, `tables`, `designed`, `operating`, `online`, `schedule`, `campaign`,
                `runner`, `recorder`, `journal`, `events`, `supervise`, `vigil`, `continued`,
                `closeloop`
run store       `store`, `store_file`, `store_writer`, `store_catalogue`, `store_upkeep`, `records`,
                `importers`, `exporters`, `locks`
outside         `service` (REST, live streams, page), `cli`, `client`
                (`documents`: files that people write; `errors`: what can go wrong in all of these)
"""
