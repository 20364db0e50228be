-- why: classes whose concept, the part before a colon, the vocabulary does not have; `raw:CODE` is what ingest makes of a
--      code that it does not know. Where such classes are welcome the table has no row
-- reads: detections
-- params: $concepts (varchar, names of the known concepts with commas between them;
--         null if not given)
-- writes: sign_class VARCHAR
SELECT DISTINCT sign_class
FROM detections
WHERE NOT list_contains(string_split($concepts, ','), split_part(sign_class, ':', 1))
ORDER BY sign_class
